"""Prior knowledge of a task for a station, and log output of environments."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from guiderail import make_env
from guiderail.diagrams.envs.assemble import Loop, build_prior_knowledge
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.envs.options import Options, PrimitiveOptions
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.tasks.task import add_constant
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import ReferenceTrajectory
from guiderail_hardware.station import HardwareStation

PERIOD = 0.02


def make_prior(turn, station):
    """Return the prior knowledge of a turn by `turn` [rad] about z, for a class of stations."""
    means = np.zeros((30, 6))
    means[:, 3] = np.linspace(0.0, turn, 30)
    reference = ReferenceTrajectory(PERIOD * np.arange(30), means, np.tile(1e-6 * np.eye(6), (30, 1, 1)))
    parts = {name: Options() for name in ("template", "guidance")} | {"primitive": PrimitiveOptions()}
    config = SimpleNamespace(
        declared=SimpleNamespace(prior=Prior), reference=lambda: reference, constraints=lambda: None, parts=parts
    )
    ports = SimpleNamespace(wraps_angles=station.wraps_angles, pose_size=6, wrench_size=6, control_period=PERIOD)
    return build_prior_knowledge(config, ports)


def test_prior_is_accepted_when_clock_factor_changes_the_period():
    env = make_env("BncConnector", disturbances={"clock_factor": 0.5})
    assert env.unwrapped.diagram.diagram.GetSubsystemByName("station").control_period == pytest.approx(0.01)


@pytest.mark.parametrize("turn", [np.pi, -np.pi, 3.1, 4.0])
def test_half_turn_is_refused_on_stations_with_wrapped_angles(turn):
    """A measured angle jumps by a full turn at ±180°, so a history of measured angles would command a full turn."""
    assert make_prior(turn, GantryStation).primitive is not None
    for station in (ArmStation, HardwareStation):
        with pytest.raises(InputError, match="angles jump by a full turn at 180°"):
            make_prior(turn, station)
        assert make_prior(0.9 * np.copysign(np.pi, turn), station).primitive is not None


def test_signal_is_refused_when_the_station_has_no_input():
    class BoundedPassage(type(EnvConfig.resolve("NarrowPassage").declared)):
        def signals(self, builder, station):
            return {**super().signals(builder, station), "max_wrench": add_constant(builder, "bound", np.ones(8))}

    config = EnvConfig.resolve("NarrowPassage")
    config = replace(config, parts={**config.parts, "task": BoundedPassage()})
    station = make_station(config)
    with pytest.raises(InputError, match="station='plane' has no input for the signal 'max_wrench' of NarrowPassage"):
        Loop(config, station, make_guidance(config, station))


def test_make_env_prints_no_log_message_of_drake(forks, tmp_path):
    script = "import guiderail\nguiderail.make_env('NarrowPassage', guidance='kgrl', render_mode='human').reset(seed=0)"
    assert forks.run("-c", script, folder=tmp_path, DRAKE_ALLOW_NETWORK="meshcat").stderr == ""
