"""Prior knowledge of a task for a station, and log output of environments."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.primitives import ConstantVectorSource

from guiderail import make_env
from guiderail.diagrams.envs.assemble import Loop, build_prior_knowledge
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import MAX_WRENCH_SIZE
from guiderail.models.primitives import ReferenceTrajectory
from guiderail_hardware.station import HardwareStation

PERIOD = 0.02


def make_prior(turn, station, period=PERIOD):
    """Return the prior knowledge of a turn by `turn` [rad] about z, for a station with the period `period` [s]."""
    means = np.zeros((30, 6))
    means[:, 3] = np.linspace(0.0, turn, 30)
    reference = ReferenceTrajectory(PERIOD * np.arange(30), means, np.tile(1e-6 * np.eye(6), (30, 1, 1)))
    task = SimpleNamespace(
        provides=lambda: {"demonstrations"},
        reference=lambda: reference,
        constraints=lambda: None,
        motion_constraints=lambda: None,
        isotropic_groups=None,
        config=SimpleNamespace(part=lambda name: {}),
    )
    ports = SimpleNamespace(
        wraps_angles=station.wraps_angles, pose_size=6, wrench_size=6, control_period=period, nominal_period=period
    )
    return build_prior_knowledge(task, ports)


@pytest.mark.parametrize("period", [0.01, 0.1])
def test_prior_is_refused_when_the_control_period_differs(period):
    with pytest.raises(InputError, match="would not have the demonstrated speed"):
        make_prior(1.0, GantryStation, period)


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
    class BoundedPassage(type(EnvConfig.resolve("NarrowPassage").make_task())):
        def signals(self, builder, station):
            bound = builder.AddSystem(ConstantVectorSource(np.ones(MAX_WRENCH_SIZE)))
            return {**super().signals(builder, station), "max_wrench": bound.get_output_port()}

    task = BoundedPassage(EnvConfig.resolve("NarrowPassage"))
    station = make_station(task)
    with pytest.raises(InputError, match="station='plane' has no input for the signal 'max_wrench' of NarrowPassage"):
        Loop(task, station, make_guidance(task, station))


def test_make_env_prints_no_log_message_of_drake(forks, tmp_path):
    script = "import guiderail\nguiderail.make_env('NarrowPassage', guidance='kgrl', render_mode='human').reset(seed=0)"
    assert forks.run("-c", script, folder=tmp_path, DRAKE_ALLOW_NETWORK="meshcat").stderr == ""
