from dataclasses import replace

import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.learner_config import PRESETS
from guiderail.tools.learning.run_folder import RunFolder
from guiderail_studies.job import refuse_another


def test_config_is_read_as_written(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(bead_config)
    assert folder.config() == bead_config


def test_config_file_has_everything_that_determines_a_run(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(bead_config)
    text = (tmp_path / "run" / "config.yaml").read_text()
    for word in ("guidance: skgrl", "action_repeat: 1", "learning_rate:", "seed: 5", "torch:", "drake:"):
        assert word in text


def test_missing_setting_has_the_default_despite_a_preset(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(replace(bead_config, preset="sac_gridclamp", learner=PRESETS["sac_gridclamp"]))
    file = tmp_path / "run" / "config.yaml"
    lines = [line for line in file.read_text().splitlines() if "exploration.ez_greedy_until" not in line]
    file.write_text("\n".join(lines))
    assert folder.config().learner == replace(PRESETS["sac_gridclamp"], ez_greedy_until=0)


def test_missing_option_has_its_default(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    incomplete = {key: value for key, value in bead_config.environment.items() if key != "observation"}
    folder.create(replace(bead_config, environment=incomplete))
    refuse_another(folder, bead_config)
    with pytest.raises(InputError, match="another environment"):
        refuse_another(folder, replace(bead_config, environment=bead_config.environment | {"action_repeat": 2}))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("batch_size: 16", "batch_size: -3"),
        ("batch_size: 16", "batch size: 16"),  # not read as a missing setting
        ("episodes: 8", "episodes: true"),
        ("episodes: 8", "episodes: '8'"),
        ("seed: 5", "seed: 2147483648"),
        ("seed: 5", "seed: 5\nseeed: 6"),
        ("seed: 5", "seed: 5\nseed: 6"),
        ("learner:", "learner: 3\nold:"),
        ("action_repeat: 1", "action_repeat: 2001-99-99"),
        ("imports: []", "imports: ['']"),
        ("imports: []", "imports: [..x]"),
        ("imports: []", f"imports: [{'[' * 99}"),
    ],
)
def test_config_file_with_invalid_content_is_refused(old, new, bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(bead_config)
    file = tmp_path / "run" / "config.yaml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(InputError) as error:
        folder.config()
    assert "\n" not in str(error.value)


TABLE = "episode,return,success,termination,steps\n0,-1.5,0,blocked,12\n1,2.5,1,success,9\n"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("-1.5", "x"), ("-1.5", "1_0"), ("-1.5", "١"), (",12\n", ",1.5\n"), (",12\n", ",inf\n"), (",12\n", ",\n"),
        (",1,success", ",7,success"), ("episode,", ","), ("return", "episode"), ("-1.5", '"'),
    ],
)  # fmt: skip
def test_table_of_episodes_refuses_text_for_numbers(old, new, tmp_path):
    (tmp_path / "episodes.csv").write_text(TABLE, encoding="utf-8")
    assert RunFolder(tmp_path).episodes()["return"].tolist() == [-1.5, 2.5]
    (tmp_path / "episodes.csv").write_text(TABLE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"episodes\.csv"):
        RunFolder(tmp_path).episodes()


@pytest.mark.parametrize("name", ["baselines", "checkpoint", "steps", "logs", "baselines/zero"])
def test_folder_with_a_link_to_another_place_is_refused(name, bead_config, tmp_path):
    folder, outside = RunFolder(tmp_path / "run"), tmp_path / "outside"
    folder.create(bead_config)
    outside.mkdir()
    link = folder.path / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(outside)
    with pytest.raises(InputError, match="is a link to a folder outside"):
        folder.config()
    with pytest.raises(InputError, match="is a link to a folder outside"), folder.locked():
        pass
    assert not any(outside.iterdir())


def test_folder_with_a_link_inside_of_it_is_read(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(bead_config)
    (folder.path / "old").mkdir()
    (folder.path / "steps").symlink_to(folder.path / "old")
    assert folder.config() == bead_config
