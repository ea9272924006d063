import math
from dataclasses import replace

import pytest

from guiderail.models.errors import InputError
from guiderail.tools.learning.presets import PRESETS
from guiderail.tools.learning.run_folder import RunFolder, converged_after, read_table, table_text


def test_a_configuration_comes_back_as_it_was_written(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(bead_config)
    assert folder.config() == bead_config


def test_everything_that_decides_a_run_is_in_its_configuration(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(bead_config)
    text = (tmp_path / "run" / "config.yaml").read_text()
    for word in ("guidance: skgrl", "hold: 1", "learning_rate:", "seed: 5", "torch:", "drake:"):
        assert word in text


def test_a_setting_that_a_run_is_older_than_is_off_whatever_its_preset_says_now(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(replace(bead_config, preset="clamp", learner=PRESETS["clamp"]))
    file = tmp_path / "run" / "config.yaml"
    lines = [line for line in file.read_text().splitlines() if "bursts_until" not in line]
    file.write_text("\n".join(lines))
    assert folder.config().learner == replace(PRESETS["clamp"], bursts_until=0)


def test_numbers_come_back_exactly(tmp_path):
    rows = [{"a": 0.1 + 0.2, "b": 3, "c": "blocked", "d": -math.inf}, {"a": 1e-300, "b": -1, "c": "", "d": 2.0}]
    (tmp_path / "t.csv").write_text(table_text(rows))
    assert read_table(tmp_path / "t.csv") == rows


@pytest.mark.parametrize("text", ["a,b\n1\n", "a,b\n1,2,3\n"])
def test_a_torn_table_is_refused(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match="not a table"):
        read_table(tmp_path / "t.csv")


def test_a_configuration_that_no_learner_can_use_is_refused(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(replace(bead_config, learner=replace(bead_config.learner, batch_size=-3)))
    with pytest.raises(InputError):
        folder.config()


@pytest.mark.parametrize(
    ("successes", "episode"),
    [("1" * 10, 0), ("0" + "1" * 10, 1), ("1" * 9, None), ("1" * 9 + "0" + "1" * 12, 10), ("", None)],
)
def test_converged_is_the_episode_after_which_ten_in_a_row_succeed(successes, episode):
    assert converged_after(s == "1" for s in successes) == episode
