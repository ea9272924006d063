"""Warnings and remarks about demonstrations, and orders of angles and quaternions at import."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_data.convert import import_recording
from guiderail_data.reading import load_demonstrations
from guiderail_data.validate import fit_bounds


def test_recording_in_another_unit_causes_a_remark(tmp_path):
    folder, times = tmp_path / "recorded", np.linspace(0.0, 1.0, 20)
    folder.mkdir()
    for index, scale in enumerate((1.0, 1.0, 1000.0)):
        rows = np.column_stack([times, scale * times, scale * times, scale * times])
        np.savetxt(folder / f"a{index}.csv", rows, delimiter=",", header="t [s],x [m],y [m],z [m]", comments="")
    message = "demonstration 2 extends over 1.73e+03 and the median one over 1.73: check its unit"
    assert fit_bounds(folder)["remark"] == message
    assert import_recording(folder, tmp_path / "out.npz")["remark"] == message


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_import_converts_zyx_angles_named_as_outputs(unit, tmp_path):
    times, angles = np.linspace(0.0, 1.0, 20), np.tile([0.5, 0.2, -0.1], (20, 1))
    header = "t [s],x [m],y [m],z [m]," + ",".join(f"{name} [{unit}]" for name in ("Rz", "Ry", "Rx"))
    rows = np.column_stack([times, times, times, times, np.rad2deg(angles) if unit == "deg" else angles])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=header, comments="")
    import_recording(tmp_path / "a.csv", tmp_path / "out.npz")
    np.testing.assert_allclose(load_demonstrations(tmp_path / "out.npz").outputs[0][:, 3:], angles, atol=1e-12)


def test_import_refuses_a_quaternion_order_unlike_its_names(tmp_path):
    rows = np.column_stack([np.linspace(0.0, 1.0, 20)] * 4 + [np.ones(20)] + [np.zeros(20)] * 3)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t [s],x [m],y [m],z [m],qw,qx,qy,qz", comments="")
    with pytest.raises(InputError, match="contradicts --quaternion xyzw: leave it out"):
        import_recording(tmp_path / "a.csv", tmp_path / "out.npz", quaternion="xyzw")
    import_recording(tmp_path / "a.csv", tmp_path / "out.npz", quaternion="wxyz")
