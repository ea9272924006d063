"""Studies by seeds refuse what is wrong in one sentence."""

import pytest

from guiderail.tools.studies import clamp_study, connector_study, pouring_study


@pytest.mark.parametrize("study", [clamp_study, connector_study, pouring_study])
@pytest.mark.parametrize(("wrong", "words"), [(["--methods", "magic"], "magic"), (["--seeds", "1,x"], "--seeds")])
def test_what_is_wrong_is_said_before_anything_is_written(study, wrong, words, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        study.main(["--out", str(tmp_path / "out"), *wrong])
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()
