import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.safety_ledger import SafetyLedger

PERIOD = 0.1
QUIET = {"commanded_violation": -1.0, "measured_violation": -1.0}


class Episode:
    """Feeds a ledger the signals of one control step after another."""

    def __init__(self, num_actuators=1):
        self.system = SafetyLedger(PERIOD, num_actuators)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.pristine = self.system.CreateDefaultContext()
        self.ports = {}
        for i in range(self.system.num_input_ports()):
            port = self.system.get_input_port(i)
            self.ports[port.get_name()] = port.size(), port.FixValue(self.context, np.zeros(port.size()))
        self.reset()

    def reset(self):
        self.context.SetTimeStateAndParametersFrom(self.pristine)
        self.steps = 0
        self.simulator.Initialize()

    def step(self, **signals):
        self.simulator.AdvanceTo((self.steps + 0.5) * PERIOD)
        for name, (size, value) in self.ports.items():
            value.GetMutableData().set_value(np.broadcast_to({**QUIET, **signals}.get(name, 0.0), size))
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * PERIOD)

    def row(self):
        values = self.system.get_ledger_output_port().Eval(self.context)
        return dict(zip(SafetyLedger.FIELDS, values, strict=True))


def test_ports():
    system = SafetyLedger(PERIOD, num_actuators=7)
    assert system.get_record_input_port("saturation").size() == 7
    for name in ("commanded_violation", "measured_violation", "contact_force", "fallback"):
        assert system.get_record_input_port(name).size() == 1
    assert system.get_ledger_output_port().size() == len(SafetyLedger.FIELDS)


def test_records_every_step_once():
    rng = np.random.default_rng(0)
    episode, forces, violations = Episode(), rng.uniform(0, 9, 50), rng.normal(size=50)
    for force, violation in zip(forces, violations, strict=True):
        episode.step(contact_force=force, commanded_violation=violation, measured_violation=2 * violation)
        episode.row()  # looking at it changes nothing
    row = episode.row()
    assert row["steps"] == 50
    assert row["peak_force"] == forces.max()
    assert row["mean_force"] == pytest.approx(forces.mean(), rel=1e-12)
    assert row["max_commanded_violation"] == violations.max()
    assert row["max_measured_violation"] == 2 * violations.max()


def test_the_worst_step_counts_even_if_it_is_the_last():
    episode = Episode()
    episode.step()
    episode.step(commanded_violation=0.3)
    assert episode.row()["max_commanded_violation"] == 0.3


def test_a_collision_lasts_as_long_as_the_contact():
    episode = Episode()
    for touching in (0, 1, 1, 1, 0, 0, 1, 0, 1):
        episode.step(collision=touching)
    assert episode.row()["collisions"] == 3
    assert episode.row()["collision_steps"] == 5


def test_counts_saturation_of_any_actuator_in_any_direction_and_fallbacks():
    episode = Episode(num_actuators=2)
    for saturation, fallback in (([0, 0], 1), ([0, -3], 0), ([1, 0], 1)):
        episode.step(saturation=np.array(saturation, float), fallback=fallback)
    assert episode.row()["saturated_steps"] == 2
    assert episode.row()["fallback_steps"] == 2


def test_not_a_number_does_not_hide_behind_a_maximum():
    episode = Episode()
    episode.step(measured_violation=5.0)
    episode.step(measured_violation=np.nan)
    assert np.isnan(episode.row()["max_measured_violation"])


def test_a_reset_empties_it():
    episode = Episode()
    for _ in range(3):
        episode.step(commanded_violation=1.0, contact_force=4.0, collision=1.0)
    episode.reset()
    episode.step()
    assert episode.row() == {
        "max_commanded_violation": -1.0,
        "max_measured_violation": -1.0,
        "peak_force": 0.0,
        "mean_force": 0.0,
        "collisions": 0.0,
        "collision_steps": 0.0,
        "saturated_steps": 0.0,
        "fallback_steps": 0.0,
        "steps": 1.0,
    }


@pytest.mark.parametrize("arguments", [(0.0,), (float("nan"),), (0.1, 0)])
def test_refuses_what_makes_no_sense(arguments):
    with pytest.raises(InputError):
        SafetyLedger(*arguments)


def test_says_that_a_robot_without_actuators_is_none():
    with pytest.raises(InputError, match="at least one actuator"):
        SafetyLedger(PERIOD, 0)
