"""Files and folders of demonstrations: reading, remarks of the validation, and refused tables."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail_data.reading import load_demonstrations
from guiderail_data.validate import fit_bounds, validate_demonstrations

CLOCK = np.linspace(0, 1, 30)


def motion(index=0):
    """Return the outputs (30, 3) of demonstration `index`."""
    return np.column_stack([np.sin(3 * CLOCK + 0.1 * index), CLOCK * index, CLOCK**2])


def write(path, index=0, header="t,x,y,z"):
    """Write demonstration `index` as a CSV table; return its path."""
    rows = [",".join(map(repr, map(float, row))) for row in np.column_stack([CLOCK, motion(index)])]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_folder_contains_the_demonstrations_of_all_files(tmp_path):
    for index in (2, 0, 1):
        write(tmp_path / f"{index}.csv", index)
    Demonstrations(CLOCK, [motion(3), motion(4)], ["x", "y", "z"]).save(tmp_path / "3.npz")
    (tmp_path / "notes.txt").write_text("text")
    loaded = load_demonstrations(tmp_path)
    assert loaded.num_demonstrations == 5
    for index, outputs in enumerate(loaded.outputs):
        np.testing.assert_array_equal(outputs, motion(index))


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_folder_is_read_without_hidden_files(ending, tmp_path):
    write(tmp_path / "0.csv")
    (tmp_path / f"._0{ending}").write_bytes(b"\x00\x05\x16\x07")
    (tmp_path / f".old{ending}").mkdir()
    assert load_demonstrations(tmp_path).num_demonstrations == 1
    (tmp_path / f"1{ending}").mkdir()
    write(tmp_path / f"1{ending}" / "2.csv", 2)
    with pytest.raises(InputError, match=f"1{ending} is a folder with the name of a file"):
        load_demonstrations(tmp_path)


def test_validate_names_the_demonstration_in_another_unit(tmp_path):
    t = np.linspace(0.0, 2.0, 50)
    for index, unit in enumerate((1.0, 1000.0, 1.0)):  # demonstration 1 in millimeters
        rows = unit * np.column_stack([t, np.sin(t) + 0.01 * index])
        np.savetxt(tmp_path / f"{index}.csv", np.column_stack([t, rows]), delimiter=",", header="time,x,y", comments="")
    assert "demonstration 1 extends over 2.24e+03 and the median" in validate_demonstrations(tmp_path)["remark"]
    (tmp_path / "1.csv").unlink()
    assert "extends over" not in validate_demonstrations(tmp_path).get("remark", "")


def test_validate_remarks_on_jumps_gaps_and_a_missing_line_end(tmp_path):
    t = np.linspace(0.0, 2.0, 101)
    file = tmp_path / "a.csv"
    np.savetxt(file, np.column_stack([t, np.sin(t)]), delimiter=",", header="time,x", comments="")
    assert not {"jumps", "gap", "line end"} & set(validate_demonstrations(file).get("remark", "").split())
    lines = file.read_text().splitlines()
    lines[41] = lines[41].split(",")[0] + ",9.0"
    file.write_text("\n".join(lines[:60] + lines[80:]))
    remark = validate_demonstrations(file)["remark"]
    assert "demonstration 0 has a gap of 0.42 after the time 1.16, and a median period of 0.02" in remark
    assert "x of demonstration 0 jumps from" in remark
    assert f"the last line of {file} has no line end" in remark


@pytest.mark.parametrize("read", [validate_demonstrations, load_demonstrations, fit_bounds])
@pytest.mark.parametrize("ending", ["", ".csv", ".npz"])
def test_readers_refuse_a_name_that_is_too_long(read, ending, tmp_path):
    with pytest.raises(InputError, match="File name too long"):
        read(tmp_path / ("x" * 300 + ending))


def test_load_demonstrations_refuses_a_table_as_training_does(tmp_path):
    (tmp_path / "wrong.csv").write_text("t,x\n1,1\n0,2\n")
    for load in (load_demonstrations, Demonstrations.load):
        with pytest.raises(InputError, match="does not increase"):
            load(tmp_path / "wrong.csv")


def test_folder_is_refused_when_empty_or_of_mixed_outputs(tmp_path):
    with pytest.raises(InputError, match="no file"):
        load_demonstrations(tmp_path)
    write(tmp_path / "a.csv")
    write(tmp_path / "b.csv", header="t,x,y,force")
    with pytest.raises(InputError, match="force"):
        load_demonstrations(tmp_path)


@pytest.mark.parametrize(("ending", "magic"), [(".png", b"\x89PNG"), (".jpg", b"\xff\xd8\xff")])
def test_picture_has_the_format_of_its_ending(tmp_path, ending, magic):
    for index in range(3):
        write(tmp_path / f"{index}.csv", index)
    picture = tmp_path / f"picture{ending}"
    assert validate_demonstrations(tmp_path, picture)["picture"] == str(picture)
    assert picture.read_bytes().startswith(magic)
    with pytest.raises(InputError, match="a picture is"):
        validate_demonstrations(tmp_path, tmp_path / "picture.gif")
