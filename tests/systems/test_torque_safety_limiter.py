from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault
from guiderail.models.robots.robot import DEFAULT_ROBOT, find_robot
from guiderail.systems.torque_safety_limiter import MAX_VELOCITY_AGE, ArmState, SafetyLimits, TorqueSafetyLimiter

PERIOD = 1.0 / 256.0
n = 7
LIMITS = SafetyLimits(
    velocity=(1.0,) * n, torque=(20.0,) * n, external_torque=(10.0,) * n, damping_time=0.25, ramp_time=0.125
)
POSTURE = np.array(find_robot(DEFAULT_ROBOT).home)
WANTED = np.linspace(-6.0, 6.0, n)
SPEED = np.linspace(0.1, 0.2, n)


@pytest.fixture(scope="module")
def plant():
    return controller_model(BncWorkcell())[0]


class Guarded:
    """A guard whose arm moves, with all well; it has taken over unless told otherwise."""

    def __init__(self, plant, running=True):
        self.plant = plant
        self.system = TorqueSafetyLimiter(plant, LIMITS, period=PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        ok = {
            "torque": WANTED,
            "estimated_state": [*POSTURE, *SPEED],
            "external_torque": np.zeros(n),
            "wrench": np.zeros(6),
            "pose": np.zeros(6),
            "desired_pose": np.zeros(6),
            "status_fault": [0.0],
            "status_age": [0.0],
            "status_is_new": [1.0],
            "command_timed_out": [0.0],
        }
        self.ports = {name: self.system.GetInputPort(name).FixValue(self.context, value) for name, value in ok.items()}
        self.ok = ok
        if running:
            self.simulator.Initialize()
            self.go(LIMITS.ramp_time + 4 * PERIOD)
            assert self.arm_state == ArmState.RUNNING

    def set(self, **values):
        for name, value in values.items():
            self.ports[name].GetMutableData().set_value(value)

    def go(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.simulator.AdvanceTo(self.context.get_time() + PERIOD)

    def __getitem__(self, port):
        return self.system.GetOutputPort(port).Eval(self.context).copy()

    @property
    def arm_state(self):
        return ArmState(int(self["arm_state"][0]))

    @property
    def fault(self):
        return Fault(int(self["fault"][0]))

    def damping(self, age=0.0):
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositionsAndVelocities(context, [*POSTURE, *SPEED])
        momentum = self.plant.CalcMassMatrix(context) @ SPEED
        T = LIMITS.decay_time
        return -momentum * np.exp(-age / T) * (1.0 - np.exp(-PERIOD / T)) / PERIOD


def test_passes_on_what_is_wanted_while_all_is_well(plant):
    guarded = Guarded(plant)
    np.testing.assert_array_equal(guarded["safe_torque"], WANTED)
    assert (guarded.fault, guarded["is_sending"][0], guarded["not_following"][0]) == (Fault.NONE, 1.0, 0.0)


def test_sends_nothing_before_the_status_is_sound_and_then_takes_over_gradually(plant):
    guarded = Guarded(plant, running=False)
    guarded.set(status_fault=[Fault.NO_STATUS])
    guarded.simulator.Initialize()
    guarded.go(0.5)
    assert guarded.arm_state == ArmState.WAITING
    assert guarded["is_sending"][0] == 0.0
    np.testing.assert_array_equal(guarded["safe_torque"], 0.0)
    guarded.set(status_fault=[0.0])
    shares = []
    while guarded.arm_state != ArmState.RUNNING:
        guarded.go(PERIOD)
        share = guarded["blend_factor"][0]
        if guarded.arm_state == ArmState.RAMPING:
            shares.append(share)
            assert guarded["not_following"][0] == 1.0
            expected = np.clip(share * WANTED + (1.0 - share) * guarded.damping(), -20.0, 20.0)
            np.testing.assert_allclose(guarded["safe_torque"], expected, atol=1e-12)
    assert len(shares) >= LIMITS.ramp_time / PERIOD - 1
    np.testing.assert_allclose(np.diff(shares), PERIOD / LIMITS.ramp_time)


WRONG = {
    Fault.STALE: {"status_fault": [Fault.STALE]},
    Fault.VELOCITY_LIMIT: {"estimated_state": [*POSTURE, *SPEED[:-1], -1.01]},
    Fault.WORKSPACE_LIMIT: {"pose": [0.0, 0.0, 0.31, 0.0, 0.0, 0.0]},
    Fault.FORCE_LIMIT: {"wrench": [40.0, 0.0, -50.0, 0.0, 0.0, 0.0]},
    Fault.EXTERNAL_TORQUE_LIMIT: {"external_torque": [0.0] * 6 + [-10.1]},
    Fault.TORQUE_NOT_FINITE: {"torque": [*WANTED[:-1], np.nan]},
}


@pytest.mark.parametrize("fault", WRONG, ids=lambda fault: fault.name)
def test_stops_at_once_says_why_and_goes_on_only_when_told(plant, fault):
    guarded = Guarded(plant)
    guarded.set(**WRONG[fault])
    assert guarded.fault == fault
    assert (guarded["safe_torque"] * guarded["safe_torque"] <= 400.0).all()
    assert not np.isclose(guarded["safe_torque"], WANTED).any()
    guarded.go(2 * PERIOD)
    guarded.set(**{name: guarded.ok[name] for name in WRONG[fault]})
    assert (guarded.arm_state, guarded.fault) == (ArmState.DAMPING, fault)
    np.testing.assert_allclose(guarded["safe_torque"], np.clip(guarded.damping(), -20.0, 20.0), atol=1e-12)
    with pytest.raises(InputError, match="is damping"):
        guarded.system.resume(guarded.context)
    guarded.go(LIMITS.damping_time)
    assert (guarded.arm_state, guarded.fault) == (ArmState.OFF, fault)
    np.testing.assert_array_equal(guarded["safe_torque"], 0.0)
    guarded.go(1.0)
    assert guarded.arm_state == ArmState.OFF
    guarded.system.resume(guarded.context)
    assert (guarded.arm_state, guarded.fault, guarded["blend_factor"][0]) == (ArmState.RAMPING, Fault.NONE, 0.0)
    guarded.go(LIMITS.ramp_time + 2 * PERIOD)
    assert guarded.arm_state == ArmState.RUNNING


def test_is_not_told_to_leave_the_workspace(plant):
    guarded = Guarded(plant)
    guarded.set(desired_pose=[0.21, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert guarded.fault == Fault.WORKSPACE_LIMIT


POSITION, VELOCITY = [*([np.nan] * n), *SPEED], [*POSTURE, *([np.nan] * n)]
NO_NUMBER = {
    "torque": ({"torque": np.full(n, np.nan)}, Fault.TORQUE_NOT_FINITE),
    "positions": ({"estimated_state": POSITION}, Fault.NOT_FINITE),
    "velocities": ({"estimated_state": VELOCITY}, Fault.NOT_FINITE),
    "infinite velocity": ({"estimated_state": [*POSTURE, *SPEED[:-1], np.inf]}, Fault.NOT_FINITE),
    "external_torque": ({"external_torque": np.full(n, np.nan)}, Fault.EXTERNAL_TORQUE_LIMIT),
    "wrench": ({"wrench": np.full(6, np.nan)}, Fault.FORCE_LIMIT),
    "pose": ({"pose": np.full(6, np.nan)}, Fault.WORKSPACE_LIMIT),
    "desired_pose": ({"desired_pose": np.full(6, np.nan)}, Fault.WORKSPACE_LIMIT),
    "status_age": ({"status_age": [np.nan]}, Fault.STALE),
}


@pytest.mark.parametrize("blend_factor", ["none", "some", "all"])
@pytest.mark.parametrize("what", NO_NUMBER)
def test_what_is_no_number_is_within_no_limit_and_what_is_sent_is_one(plant, what, blend_factor):
    """Whether the arm waits, takes over or runs, when it stops and until it is off."""
    wrong, fault = NO_NUMBER[what]
    guarded = Guarded(plant, running=blend_factor == "all")
    if blend_factor != "all":
        guarded.simulator.Initialize()
        guarded.go(0.5 * LIMITS.ramp_time if blend_factor == "some" else 0.0)
    guarded.set(**wrong)
    assert np.isfinite(guarded["safe_torque"]).all()
    if blend_factor == "none" and what == "desired_pose":
        return  # nobody is told to go anywhere yet
    assert guarded.fault == fault
    for _ in range(round(LIMITS.damping_time / PERIOD) + 4):
        guarded.go(PERIOD)
        assert np.isfinite(guarded["safe_torque"]).all()
        assert guarded.fault == fault
    assert guarded.arm_state == (ArmState.WAITING if blend_factor == "none" else ArmState.OFF)


@pytest.mark.parametrize(
    "wrong", [{"estimated_state": POSITION}, {"estimated_state": VELOCITY}, {"status_age": [np.nan]}]
)
def test_a_speed_that_nobody_knows_is_not_damped(plant, wrong):
    guarded = Guarded(plant)
    guarded.set(status_fault=[Fault.NOT_FINITE], **wrong)
    for _ in range(3):
        np.testing.assert_array_equal(guarded["safe_torque"], 0.0)
        guarded.go(PERIOD)
    assert guarded.arm_state == ArmState.DAMPING


def test_torques_that_come_out_as_no_numbers_are_none(plant):
    """From whatever in the state, which a station before this one may have left."""
    guarded = Guarded(plant)
    guarded.set(status_fault=[Fault.STALE], status_is_new=[0.0])
    assert guarded["safe_torque"].any()
    guarded.context.SetDiscreteState(1, np.full(n, np.nan))
    np.testing.assert_array_equal(guarded["safe_torque"], 0.0)


def test_does_not_go_on_while_something_is_wrong(plant):
    guarded = Guarded(plant)
    guarded.set(status_fault=[Fault.NOT_FINITE])
    guarded.go(1.0)
    with pytest.raises(InputError, match="NaN or infinity"):
        guarded.system.resume(guarded.context)
    assert guarded.arm_state == ArmState.OFF


def test_never_sends_more_than_the_limits(plant):
    guarded = Guarded(plant)
    guarded.set(torque=np.linspace(-200.0, 200.0, n))
    np.testing.assert_array_equal(guarded["safe_torque"], np.clip(np.linspace(-200.0, 200.0, n), -20.0, 20.0))


@pytest.mark.parametrize("before", [0, 1, 8])  # periods for which no status had come when that was found
def test_damping_takes_away_exactly_what_the_arm_had_and_was_given_since(plant, before):
    """Where no status comes, the speed is that of the last one for ever: what is taken away in all is its momentum."""
    guarded, load = Guarded(plant), np.full(n, 0.5)
    guarded.set(estimated_state=[*POSTURE, *(0.1 * SPEED)], external_torque=load)
    guarded.go(PERIOD)
    given, taken = np.zeros(n), np.zeros(n)
    for age in range(before):
        if age > 0:
            guarded.set(status_age=[age * PERIOD], status_is_new=[0.0])
        seen = np.clip(2.0 - age, 0.0, 1.0)
        np.testing.assert_allclose(guarded["safe_torque"], seen * WANTED)
        given += PERIOD * seen * (WANTED + load)
        guarded.go(PERIOD)
    guarded.set(status_fault=[Fault.STALE])
    for step in range(round(LIMITS.damping_time / PERIOD)):
        guarded.set(status_age=[(before + step) * PERIOD], status_is_new=[float(before + step == 0)])
        taken += PERIOD * guarded["safe_torque"]
        guarded.go(PERIOD)
    momentum = -guarded.damping() * PERIOD / (1.0 - np.exp(-PERIOD / LIMITS.decay_time))
    np.testing.assert_allclose(taken, -0.1 * momentum - given, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("first", "then", "has_torque"), [(2, 3, False), (3, 3, True), (2, 2, True), (2, 4, True)])
def test_a_robot_that_was_started_anew_is_not_driven_by_the_speed_that_it_had(plant, first, then, has_torque):
    """Silence, and then a clock that is behind; one that jumps without it, or ahead, is the same robot's: damped."""
    guarded = Guarded(plant)
    for status_fault in (first, first, then):
        guarded.set(status_fault=[float(status_fault)])
        guarded.go(PERIOD)
    assert guarded["safe_torque"].any() == has_torque
    assert guarded.arm_state == (ArmState.DAMPING if has_torque else ArmState.OFF)


@pytest.mark.parametrize(("age", "has_torque"), [(0.08, True), (MAX_VELOCITY_AGE, True), (0.2, False)])
def test_a_speed_of_long_ago_is_not_damped(plant, age, has_torque):
    """Whoever was held up himself: somebody else may have stopped the arm meanwhile."""
    guarded = Guarded(plant)
    guarded.set(status_age=[age], status_fault=[Fault.STALE])
    for _ in range(3):
        assert guarded["safe_torque"].any() == has_torque
        guarded.go(PERIOD)


def test_what_is_wanted_of_an_arm_that_is_not_seen_fades(plant):
    guarded = Guarded(plant)
    sent = []
    for age in (0.0, 1.0, 1.5, 2.0, 3.0, np.inf):
        guarded.set(status_age=[age * PERIOD])
        sent.append(guarded["safe_torque"])
    wanted = guarded.ok["torque"]
    np.testing.assert_allclose(sent, np.outer([1.0, 1.0, 0.5, 0.0, 0.0, 0.0], wanted))
    assert guarded.fault == Fault.NONE


def test_a_silent_robot_is_sent_no_torque_and_then_nothing(plant):
    guarded = Guarded(plant)
    guarded.set(status_fault=[Fault.STALE])
    sent = []
    for _ in range(round(0.5 / PERIOD)):
        guarded.go(PERIOD)
        sent.append(guarded["safe_torque"] if guarded["is_sending"][0] else None)
    last = [torque for torque in sent if torque is not None][-5:]
    np.testing.assert_array_equal(last, 0.0)
    assert sent[-1] is None
    guarded.set(status_fault=[0.0])
    np.testing.assert_array_equal(guarded["is_sending"], 1.0)
    np.testing.assert_array_equal(guarded["safe_torque"], 0.0)


def test_stops_when_asked(plant):
    guarded = Guarded(plant)
    guarded.system.stop(guarded.context)
    assert (guarded.arm_state, guarded.fault, guarded["blend_factor"][0]) == (ArmState.DAMPING, Fault.USER_STOP, 0.0)
    with pytest.raises(InputError):
        guarded.system.resume(guarded.context)
    guarded.go(LIMITS.damping_time + 2 * PERIOD)
    assert guarded.arm_state == ArmState.OFF
    guarded.system.stop(guarded.context)
    assert (guarded.arm_state, guarded.fault) == (ArmState.OFF, Fault.USER_STOP)


def test_an_arm_that_was_never_taken_over_is_stopped_without_a_word(plant):
    """While statuses are not believed yet there is no speed to damp and nothing to take back."""
    guarded = Guarded(plant, running=False)
    guarded.set(status_fault=[Fault.NO_STATUS])
    guarded.simulator.Initialize()
    guarded.go(10 * PERIOD)
    assert guarded.arm_state == ArmState.WAITING
    guarded.system.stop(guarded.context)
    assert (guarded.arm_state, guarded.fault) == (ArmState.OFF, Fault.USER_STOP)
    for _ in range(100):
        guarded.go(PERIOD)
        assert guarded["is_sending"][0] == 0.0
        np.testing.assert_array_equal(guarded["safe_torque"], 0.0)


def test_only_a_stopped_arm_goes_on(plant):
    guarded = Guarded(plant)
    with pytest.raises(InputError, match="is running"):
        guarded.system.resume(guarded.context)


def test_the_limits_unless_others_are_given():
    limits = SafetyLimits(velocity=(1.0,), torque=(1.0,), external_torque=(1.0,))
    assert (limits.force, limits.lower, limits.upper) == (60.0, (-0.2, -0.2, -0.1), (0.2, 0.2, 0.3))
    assert (limits.damping_time, limits.decay_time, limits.ramp_time) == (0.2, 0.02, 0.5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"velocity": (1.0,) * 6},
        {"torque": (20.0,) * 8},
        {"external_torque": (10.0,) * 6},
        {"velocity": (0.0,) * n},
        {"torque": (np.inf,) * n},
        {"external_torque": (-1.0,) * n},
        {"force": np.nan},
        {"damping_time": 0.0},
        {"decay_time": 0.0},
        {"ramp_time": 0.0},
        {"lower": (-0.2, -0.2, 0.3)},
    ],
)
def test_refuses_limits_that_make_no_sense(wrong):
    with pytest.raises(InputError):
        replace(LIMITS, **wrong)


def test_refuses_an_arm_that_the_limits_do_not_fit(plant):
    with pytest.raises(InputError, match="7 joints"):
        TorqueSafetyLimiter(plant, SafetyLimits((1.0,) * 6, (1.0,) * 6, (1.0,) * 6), period=PERIOD)
    TorqueSafetyLimiter(plant, LIMITS, period=0.5 * LIMITS.decay_time)
    with pytest.raises(InputError, match="rest"):
        TorqueSafetyLimiter(plant, LIMITS, period=0.51 * LIMITS.decay_time)
    with pytest.raises(InputError):
        TorqueSafetyLimiter(plant, LIMITS, period=0.0)


def test_what_is_exactly_at_a_limit_is_within_it_and_of_the_wrench_the_force_counts(plant):
    guarded = Guarded(plant)
    for at_limit in (
        {"estimated_state": [*POSTURE, *[1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0]]},
        {"pose": [*LIMITS.lower, 9.0, 9.0, 9.0], "desired_pose": [*LIMITS.upper, 9.0, 9.0, 9.0]},
        {"pose": [*LIMITS.upper, 9.0, 9.0, 9.0], "desired_pose": [*LIMITS.lower, 9.0, 9.0, 9.0]},
        {"wrench": [0.0, -60.0, 0.0, 99.0, 99.0, 99.0]},
        {"external_torque": [10.0, -10.0] * 3 + [10.0]},
    ):
        guarded.set(**at_limit)
        assert guarded.fault == Fault.NONE, at_limit


def test_outputs_have_the_sizes_that_they_say_and_depend_at_once_on_no_more(plant):
    system = TorqueSafetyLimiter(plant, LIMITS, period=PERIOD)
    outputs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert {port.get_name(): port.size() for port in outputs} == {
        **{"safe_torque": n, "fault": 1, "arm_state": 1, "blend_factor": 1, "is_sending": 1, "not_following": 1}
    }
    at_once = {
        port.get_name(): {
            system.get_input_port(i).get_name()
            for i in range(system.num_input_ports())
            if system.HasDirectFeedthrough(i, port.get_index())
        }
        for port in outputs
    }
    measured = {"estimated_state", "external_torque", "wrench", "pose", "desired_pose", "torque"}
    assert at_once == {
        "safe_torque": measured | {"status_fault", "status_age", "status_is_new"},
        "fault": measured | {"status_fault", "status_age"},
        "arm_state": set(),
        "blend_factor": set(),
        "is_sending": {"status_fault"},
        "not_following": {"command_timed_out"},
    }


def test_before_it_is_initialized_it_waits_and_sends_nothing(plant):
    guarded = Guarded(plant, running=False)
    assert (guarded.arm_state, guarded["is_sending"][0], guarded["not_following"][0]) == (ArmState.WAITING, 0.0, 1.0)
    np.testing.assert_array_equal(guarded["safe_torque"], 0.0)


def test_while_it_takes_over_it_damps_the_speed_that_is_seen_and_nothing_that_it_gave(plant):
    guarded = Guarded(plant, running=False)
    guarded.simulator.Initialize()
    guarded.go(LIMITS.ramp_time / 2)
    assert guarded.arm_state == ArmState.RAMPING
    guarded.set(status_age=[PERIOD], status_is_new=[0.0])
    guarded.go(PERIOD)
    share = guarded["blend_factor"][0]
    expected = share * WANTED + (1.0 - share) * guarded.damping(age=PERIOD)
    np.testing.assert_allclose(guarded["safe_torque"], np.clip(expected, -20.0, 20.0), atol=1e-12)


def test_while_a_watchdog_holds_the_arm_is_not_following(plant):
    guarded = Guarded(plant)
    guarded.set(command_timed_out=[1.0])
    assert (guarded.arm_state, guarded["not_following"][0]) == (ArmState.RUNNING, 1.0)
