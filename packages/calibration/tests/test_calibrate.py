import json
import shlex

import numpy as np
import pytest
import yaml

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main
from guiderail.tools.environments import changed_environment
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.learning.environment_set import load_variants
from guiderail_calibration.calibrate import calibrate
from guiderail_calibration.parameters import select_parameters
from guiderail_calibration.probe import probe_options, record_options
from guiderail_calibration.recordings import load_recordings
from guiderail_calibration.simulations import Simulator, draw_prior, simulate_all

RUN, GANTRY = "pretrained:connector", {"station": "gantry"}


def record(folder, environment, episodes):
    """Write a probing motion, and record episodes of it on a stiff robot by the printed command; return the folder."""
    command = record_options(RUN, environment, folder / "probe.npz")["record"].partition(" --episodes ")[0]
    further = f" --env disturbances.stiffness_factor=1.7 --episodes {episodes} --processes 1 --steps"
    with pytest.raises(SystemExit) as exit_info:
        main([*shlex.split(command + further)[1:], str(folder / "recordings")])
    assert not exit_info.value.code
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record(tmp_path_factory.mktemp("calibration"), GANTRY, 1)


def test_probing_motion_presses_within_the_force_limit(recorded):
    (episode,) = load_recordings(recorded / "recordings")
    assert 3.0 < np.linalg.norm(episode.wrench[:, :3], axis=1).max() < 20.0
    assert np.ptp(episode.pose[25:37, 1]) > 1e-4  # slides on the rim


def test_probing_motion_shows_the_clearance_in_the_hole(recorded):
    config = find_subject(RUN, None).config
    base = changed_environment(config.task, config.environment, GANTRY)
    rim = EnvConfig.resolve(config.task, base).declared.rim_contact().height
    environment = {**base, **probe_options(recorded / "probe.npz", base)}
    parameters, _ = select_parameters(config.task, base, ["clearance"])
    play = []
    for quantile in (0.0, 1.0):
        simulator = Simulator(config.task, environment, parameters)
        (episode,), _ = simulator.simulate(np.array([quantile]), 5, 1)
        assert abs(episode.pose[40, 2] - rim) < 5e-4  # stands on the rim
        assert episode.pose[137, 2] - rim < -2e-3  # is in the hole
        play.append(np.ptp(episode.pose[112:137, 0]))
    assert play[0] < 5e-5
    assert play[1] > 1e-4


def test_calibration_is_resumed_and_writes_its_files(tmp_path, monkeypatch):
    # One recorded episode, few draws of one episode each, and one flow: more are for coverage, not tested here. With
    # the coarse time step, the motion shows the stiffness but does not enter the hole.
    coarse = GANTRY | {"time_step": 0.01}
    recordings = record(tmp_path, coarse, 1) / "recordings"
    monkeypatch.setitem(simulate_all.__kwdefaults__, "episodes", 1)
    monkeypatch.setattr("guiderail_calibration.calibrate.MIN_DRAWS", 8)
    monkeypatch.setattr("guiderail_calibration.calibrate.EPISODES_OF_PREDICTION", 1)
    monkeypatch.setattr("guiderail_calibration.inference.MEMBERS", 1)
    monkeypatch.setattr("guiderail_calibration.prediction._GRID", 49)  # an eighth of the time of 99
    sentences = []
    arguments = {
        "probe": tmp_path / "probe.npz", "environment": coarse, "parameters": ["stiffness"], "draws": 10,
        "predicted": 1, "out": tmp_path / "out", "processes": 1, "log": sentences.append,
    }  # fmt: skip
    result = calibrate(RUN, recordings, **arguments)
    (row,) = result["parameters"]
    assert row["identifiable"] == "yes"
    # Coverage of the intervals needs many robots (`python -m research.calibration`); this is one, with 10 draws.
    assert row["low"] > 1.0  # the robot is stiffer than the nominal one
    assert np.sqrt(row["low"] * row["high"]) == pytest.approx(1.7, rel=0.2)
    assert row["high"] / row["low"] < 0.5 * row["prior_high"] / row["prior_low"]
    assert sentences
    assert sentences[0].startswith("stiffness: the summaries explain")
    assert result["prediction"]["episodes"] == 1
    stored = load_variants(result["variants"])
    assert len(stored) == 10
    assert all(0.5 <= variant["disturbances.stiffness_factor"] <= 2.0 for variant in stored.values())
    page = (tmp_path / "out" / "calibration.html").read_text()
    assert "impedance stiffness (factor)" in page
    assert page.count("<svg") == 2
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["parameters"] == result["parameters"]
    assert yaml.safe_load((tmp_path / "out" / "variants.yaml").read_text())

    def refuse(*_):
        raise AssertionError("simulated again")

    episodes = load_recordings(recordings)  # on the page, in place of simulated ones
    monkeypatch.setattr(Simulator, "simulate", lambda *_: (episodes, []))
    monkeypatch.setattr("guiderail_calibration.simulations._write", refuse)
    again = calibrate(RUN, recordings, **arguments)
    assert again["parameters"] == result["parameters"]


def test_without_recordings_the_variants_are_draws_of_the_prior(tmp_path, capsys):
    command = ["calibrate", RUN, "--env", "station=gantry", "--variants", "3", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as exit_info:
        main(command)
    assert not exit_info.value.code
    stored = load_variants(tmp_path / "variants.yaml")
    stiffness = [variant["disturbances.stiffness_factor"] for variant in stored.values()]
    assert len(set(stiffness)) == 3
    assert all(0.5 <= value <= 2.0 for value in stiffness)
    assert {variant["station"] for variant in stored.values()} == {"gantry"}
    with pytest.raises(SystemExit) as exit_info:
        main([*command, "--probe", str(tmp_path / "probe.npz")])
    assert exit_info.value.code == 2
    assert "give --recordings too" in capsys.readouterr().err


def test_task_without_demonstrations_from_a_file_is_not_probed(tmp_path):
    with pytest.raises(InputError, match="GridClamp takes no demonstrations from a file"):
        record_options("pretrained:clamp", {}, tmp_path / "probe.npz")


def test_recordings_that_cannot_be_used_are_refused(recorded, tmp_path):
    with pytest.raises(InputError, match="has no recorded episode"):
        load_recordings(tmp_path)
    with pytest.raises(InputError, match="there is no folder"):
        load_recordings(tmp_path / "missing")
    other = find_subject(RUN, None).config
    nominal = np.zeros((151, 6))
    with pytest.raises(InputError, match="another motion than the probing motion"):
        load_recordings(recorded / "recordings", nominal)
    (source, *_) = sorted((recorded / "recordings").glob("*.parquet"))
    (tmp_path / source.name).write_bytes(source.read_bytes()[:-200])
    with pytest.raises(InputError, match="damaged"):
        load_recordings(tmp_path)
    assert other.task == "BncConnector"


def test_too_few_draws_are_refused(recorded):
    with pytest.raises(InputError, match="the number of draws of the prior must be a whole number of at least 40"):
        calibrate(RUN, recorded / "recordings", draws=3, out=recorded / "few")


def test_damaged_simulation_is_named(recorded, tmp_path):
    config = find_subject(RUN, None).config
    base = changed_environment(config.task, config.environment, GANTRY)
    parameters, _ = select_parameters(config.task, base, ["friction"])
    simulator = Simulator(config.task, {**base, **probe_options(recorded / "probe.npz", base)}, parameters)
    (tmp_path / "00000.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match="is damaged: delete it"):
        simulate_all(simulator, tmp_path, draw_prior(1, 1), processes=1)
