import contextlib
from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots import DEFAULT_ROBOT
from guiderail.models.robots.robot import find_robot
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.systems.torque_safety_limiter import (
    ZERO_TORQUE_TIME,
    ArmState,
    SafetyLimits,
    TorqueSafetyLimiter,
)

PERIOD = 1.0 / 256.0
n = 7
LIMITS = SafetyLimits(
    velocity=(1.0,) * n, torque=(20.0,) * n, external_torque=(10.0,) * n, damping_time=0.25, ramp_time=0.125
)
POSTURE = np.array(find_robot(DEFAULT_ROBOT).home)
COMMANDED = np.linspace(-6.0, 6.0, n)
SPEED = np.linspace(0.07, 0.14, n)


@pytest.fixture(scope="module")
def plant():
    return controller_model(BncWorkcell())[0]


class Rig:
    """Limiter of a moving arm without faults, initially in the state RUNNING by default."""

    def __init__(self, plant, running=True, **options):
        self.plant = plant
        self.system = TorqueSafetyLimiter(plant, LIMITS, period=PERIOD, **options)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.valid = {
            "torque": COMMANDED,
            "estimated_state": [*POSTURE, *SPEED],
            "external_torque": np.zeros(n),
            "wrench": np.zeros(6),
            "pose": np.zeros(6),
            "desired_pose": np.zeros(6),
            "status_fault": [0.0],
            "status_age": [0.0],
            "velocity": SPEED,
            "reported_speed": [np.nan],
            "command_timed_out": [0.0],
        }
        self.ports = {
            name: self.system.GetInputPort(name).FixValue(self.context, value) for name, value in self.valid.items()
        }
        if running:
            self.simulator.Initialize()
            self.advance(LIMITS.ramp_time + 4 * PERIOD)
            assert self.arm_state == ArmState.RUNNING

    def set(self, **values):
        for name, value in values.items():
            self.ports[name].GetMutableData().set_value(value)

    def advance(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.simulator.AdvanceTo(self.context.get_time() + PERIOD)

    def __getitem__(self, port):
        return self.system.GetOutputPort(port).Eval(self.context).copy()

    @property
    def arm_state(self):
        return ArmState(int(self["arm_state"][0]))

    @property
    def state(self):
        """Return arm state, fault, time in the state, blend factor, speed at the stop, and 1 if the hold is refused."""
        return self.context.get_discrete_state().value(0).copy()

    @property
    def fault(self):
        return Fault(int(self["fault"][0]))

    def damping(self, velocity=SPEED):
        """Return the damping torque (7,) at this velocity [rad/s], without limits."""
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, POSTURE)
        momentum = self.plant.CalcMassMatrix(context) @ velocity
        return -momentum * (1.0 - np.exp(-PERIOD / LIMITS.decay_time)) / PERIOD


def test_commanded_torque_is_passed_through_without_faults(plant):
    rig = Rig(plant)
    np.testing.assert_array_equal(rig["safe_torque"], COMMANDED)
    assert (rig.fault, rig["is_sending"][0], rig["not_following"][0]) == (Fault.NONE, 1.0, 0.0)
    with pytest.raises(InputError, match="is running"):
        rig.system.resume(rig.context)
    rig.set(command_timed_out=[1.0])
    assert (rig.arm_state, rig["not_following"][0]) == (ArmState.RUNNING, 1.0)


def test_torque_ramps_up_when_the_status_becomes_valid(plant):
    rig = Rig(plant, running=False)
    rig.set(status_fault=[Fault.NO_STATUS])
    rig.simulator.Initialize()
    rig.advance(0.5)
    assert rig.arm_state == ArmState.WAITING
    assert rig["is_sending"][0] == 0.0
    np.testing.assert_array_equal(rig["safe_torque"], 0.0)
    rig.set(status_fault=[0.0], status_age=[PERIOD], velocity=0.5 * SPEED)  # another velocity than the reported one
    shares = []
    while rig.arm_state != ArmState.RUNNING:
        rig.advance(PERIOD)
        share = rig["blend_factor"][0]
        if rig.arm_state == ArmState.RAMPING:
            shares.append(share)
            assert rig["not_following"][0] == 1.0
            expected = np.clip(share * COMMANDED + (1.0 - share) * rig.damping(0.5 * SPEED), -20.0, 20.0)
            np.testing.assert_allclose(rig["safe_torque"], expected, atol=1e-12)
    assert len(shares) >= LIMITS.ramp_time / PERIOD - 1
    np.testing.assert_allclose(np.diff(shares), PERIOD / LIMITS.ramp_time)


FAULTS = {
    Fault.STALE: {"status_fault": [Fault.STALE]},
    Fault.VELOCITY_LIMIT: {"estimated_state": [*POSTURE, *SPEED[:-1], -1.01]},
    Fault.WORKSPACE_LIMIT: {"pose": [0.0, 0.0, 0.31, 0.0, 0.0, 0.0]},
    Fault.FORCE_LIMIT: {"wrench": [40.0, 0.0, -50.0, 0.0, 0.0, 0.0]},
    Fault.EXTERNAL_TORQUE_LIMIT: {"external_torque": [0.0] * 6 + [-10.1]},
    Fault.TORQUE_NOT_FINITE: {"torque": [*COMMANDED[:-1], np.nan]},
}


@pytest.mark.parametrize("code", [np.nan, np.inf, -1.0, 0.5, 99.0])
def test_unknown_status_fault_stops_the_arm(plant, code):
    rig = Rig(plant, can_hold=True)
    rig.set(status_fault=[code])
    assert rig.fault == Fault.MALFORMED
    rig.advance(2 * PERIOD)
    assert (rig.arm_state, rig.fault, rig["is_holding"][0]) == (ArmState.DAMPING, Fault.MALFORMED, 1.0)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault_stops_the_arm_until_a_resume(plant, fault):
    rig = Rig(plant)
    rig.set(**FAULTS[fault])
    assert rig.fault == fault
    assert (rig["safe_torque"] * rig["safe_torque"] <= 400.0).all()
    assert not np.isclose(rig["safe_torque"], COMMANDED).any()
    rig.advance(2 * PERIOD)
    rig.set(**{name: rig.valid[name] for name in FAULTS[fault]})
    assert (rig.arm_state, rig.fault, rig["blend_factor"][0]) == (ArmState.DAMPING, fault, 0.0)
    np.testing.assert_allclose(rig["safe_torque"], np.clip(rig.damping(), -20.0, 20.0), atol=1e-12)
    with pytest.raises(InputError, match="is damping"):
        rig.system.resume(rig.context)
    rig.advance(LIMITS.damping_time)
    assert (rig.arm_state, rig.fault) == (ArmState.OFF, fault)
    np.testing.assert_array_equal(rig["safe_torque"], 0.0)
    rig.advance(1.0)
    assert rig.arm_state == ArmState.OFF
    rig.system.resume(rig.context)
    assert (rig.arm_state, rig.fault, rig["blend_factor"][0]) == (ArmState.RAMPING, Fault.NONE, 0.0)
    rig.advance(LIMITS.ramp_time + 2 * PERIOD)
    assert rig.arm_state == ArmState.RUNNING


POSITION, VELOCITY = [*([np.nan] * n), *SPEED], [*POSTURE, *([np.nan] * n)]
NOT_FINITE = {
    "torque": ({"torque": np.full(n, np.nan)}, Fault.TORQUE_NOT_FINITE),
    "infinite torque": ({"torque": [*COMMANDED[:-1], np.inf]}, Fault.TORQUE_NOT_FINITE),
    "positions": ({"estimated_state": POSITION}, Fault.NOT_FINITE),
    "velocities": ({"estimated_state": VELOCITY}, Fault.NOT_FINITE),
    "infinite velocity": ({"estimated_state": [*POSTURE, *SPEED[:-1], np.inf]}, Fault.NOT_FINITE),
    "external_torque": ({"external_torque": np.full(n, np.nan)}, Fault.EXTERNAL_TORQUE_LIMIT),
    "wrench": ({"wrench": np.full(6, np.nan)}, Fault.FORCE_LIMIT),
    "pose": ({"pose": np.full(6, np.nan)}, Fault.WORKSPACE_LIMIT),
    "desired_pose": ({"desired_pose": np.full(6, np.nan)}, Fault.WORKSPACE_LIMIT),
    "status_age": ({"status_age": [np.nan]}, Fault.STALE),
    "velocity": ({"velocity": np.full(n, np.nan), "wrench": np.full(6, np.nan)}, Fault.FORCE_LIMIT),
}


@pytest.mark.parametrize("state", [ArmState.WAITING, ArmState.RAMPING, ArmState.RUNNING])
@pytest.mark.parametrize("name", NOT_FINITE)
def test_non_finite_input_is_a_fault_with_finite_torque(plant, name, state):
    """The torque is finite in each state of the arm, at the stop, and until the arm is off."""
    inputs, fault = NOT_FINITE[name]
    rig = Rig(plant, running=state == ArmState.RUNNING)
    if state != ArmState.RUNNING:
        rig.simulator.Initialize()
        rig.advance(0.5 * LIMITS.ramp_time if state == ArmState.RAMPING else 0.0)
    assert rig.arm_state == state
    rig.set(**inputs)
    assert np.isfinite(rig["safe_torque"]).all()
    if state == ArmState.WAITING and name == "desired_pose":
        assert rig.fault == Fault.NONE  # a waiting arm does not follow the desired pose
        return
    assert rig.fault == fault
    for _ in range(round(LIMITS.damping_time / PERIOD) + 4):
        rig.advance(PERIOD)
        assert np.isfinite(rig["safe_torque"]).all()
        assert rig.fault == fault
    assert rig.arm_state == (ArmState.WAITING if state == ArmState.WAITING else ArmState.OFF)


@pytest.mark.parametrize("inputs", [{"estimated_state": POSITION}, {"velocity": [*SPEED[:-1], np.inf]}])
def test_damping_torque_is_zero_at_unknown_velocity_or_posture(plant, inputs):
    rig = Rig(plant)
    rig.set(status_fault=[Fault.NOT_FINITE], **inputs)
    for _ in range(3):
        np.testing.assert_array_equal(rig["safe_torque"], 0.0)
        rig.advance(PERIOD)
    assert rig.arm_state == ArmState.DAMPING


@pytest.mark.parametrize("velocity", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("running", [False, True])
def test_commanded_torque_is_not_damped_at_unknown_velocity(plant, velocity, running):
    rig = Rig(plant, running=running)
    if not running:
        rig.simulator.Initialize()
        rig.advance(0.5 * LIMITS.ramp_time)
    rig.set(velocity=[*SPEED[:-1], velocity])
    assert rig.arm_state == (ArmState.RUNNING if running else ArmState.RAMPING)
    np.testing.assert_array_equal(rig["safe_torque"], rig["blend_factor"][0] * COMMANDED)


def test_damping_torque_is_zero_for_a_joint_that_overflows(plant):
    rig = Rig(plant)
    velocity = 1e308 * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    rig.set(velocity=velocity, status_fault=[Fault.FROZEN])
    with np.errstate(all="ignore"):
        torque = rig.damping(velocity)
        assert not np.isfinite(torque).all()
        expected = np.where(np.isfinite(torque), np.clip(torque, -20.0, 20.0), 0.0)
        np.testing.assert_array_equal(rig["safe_torque"], expected)


def test_stop_damps_the_estimated_not_the_reported_velocity(plant):
    rig = Rig(plant)
    rig.set(estimated_state=[*POSTURE, *(-5.0 * SPEED)], velocity=0.5 * SPEED, status_fault=[Fault.FROZEN])
    for _ in range(3):
        np.testing.assert_allclose(rig["safe_torque"], rig.damping(0.5 * SPEED), atol=1e-12)
        rig.advance(PERIOD)


def test_resume_is_refused_while_a_fault_is_present(plant):
    rig = Rig(plant)
    rig.set(status_fault=[Fault.NOT_FINITE])
    rig.advance(1.0)
    with pytest.raises(InputError, match="NaN or infinity"):
        rig.system.resume(rig.context)
    assert rig.arm_state == ArmState.OFF


def test_commanded_torque_fades_out_when_the_status_is_old(plant):
    rig = Rig(plant)
    sent = []
    for age in (0.0, 1.0, 1.5, 2.0, 3.0, np.inf):
        rig.set(status_age=[age * PERIOD])
        sent.append(rig["safe_torque"])
    commanded = rig.valid["torque"]
    np.testing.assert_allclose(sent, np.outer([1.0, 1.0, 0.5, 0.0, 0.0, 0.0], commanded))
    assert rig.fault == Fault.NONE


def test_zero_torque_and_then_no_torque_is_sent_without_status(plant):
    rig = Rig(plant)
    rig.set(status_fault=[Fault.STALE])
    sent = []
    for _ in range(round(0.5 / PERIOD)):
        rig.advance(PERIOD)
        sent.append(rig["safe_torque"] if rig["is_sending"][0] else None)
    last = [torque for torque in sent if torque is not None][-5:]
    np.testing.assert_array_equal(last, 0.0)
    assert sent[-1] is None
    rig.set(status_fault=[0.0])
    np.testing.assert_array_equal(rig["is_sending"], 1.0)
    np.testing.assert_array_equal(rig["safe_torque"], 0.0)


def test_stop_damps_the_arm(plant):
    rig = Rig(plant)
    rig.system.stop(rig.context)
    assert (rig.arm_state, rig.fault, rig["blend_factor"][0]) == (ArmState.DAMPING, Fault.USER_STOP, 0.0)
    with pytest.raises(InputError):
        rig.system.resume(rig.context)
    rig.advance(LIMITS.damping_time + 2 * PERIOD)
    assert rig.arm_state == ArmState.OFF
    rig.system.stop(rig.context)
    assert (rig.arm_state, rig.fault) == (ArmState.OFF, Fault.USER_STOP)


def test_no_torque_is_sent_when_a_waiting_arm_is_stopped(plant):
    """Before the first valid status, the velocity is unknown and no torque has been sent."""
    rig = Rig(plant, running=False)
    rig.set(status_fault=[Fault.NO_STATUS])
    rig.simulator.Initialize()
    rig.advance(10 * PERIOD)
    assert rig.arm_state == ArmState.WAITING
    rig.system.stop(rig.context)
    assert (rig.arm_state, rig.fault, rig["blend_factor"][0]) == (ArmState.OFF, Fault.USER_STOP, 0.0)
    for _ in range(100):
        rig.advance(PERIOD)
        assert rig["is_sending"][0] == 0.0
        np.testing.assert_array_equal(rig["safe_torque"], 0.0)


@pytest.mark.parametrize(
    ("speed", "rest", "is_refused"),
    [(0.149, 0.0, False), (0.151, 0.0, True), (0.151, 0.15 - 2 * PERIOD, True), (0.151, 0.15 + 2 * PERIOD, False)],
)
def test_resume_is_refused_while_the_arm_moves(plant, speed, rest, is_refused):
    """Statuses of another robot, which moves, are not followed."""
    rig = Rig(plant)
    rig.set(status_fault=[Fault.STALE])
    rig.advance(LIMITS.damping_time + 1.0)
    assert rig.arm_state == ArmState.OFF
    moving = speed * np.eye(n)[2]
    rig.set(status_fault=[0.0], velocity=moving, estimated_state=[*POSTURE, *moving])
    rig.advance(2 * PERIOD)
    rig.set(velocity=SPEED, estimated_state=[*POSTURE, *SPEED])
    rig.advance(rest)
    with pytest.raises(InputError, match="it moves") if is_refused else contextlib.nullcontext():
        rig.system.resume(rig.context)


def test_resume_is_refused_while_the_reported_speed_is_large(plant):
    """The estimated velocity is zero while it is unknown; another robot reports its own."""
    rig = Rig(plant)
    rig.set(status_fault=[Fault.STALE])
    rig.advance(LIMITS.damping_time + 1.0)
    rest = np.zeros(n)
    rig.set(velocity=rest, estimated_state=[*POSTURE, *rest], reported_speed=[0.151])
    rig.advance(0.5)
    rig.set(status_fault=[0.0])
    rig.advance(2 * PERIOD)
    with pytest.raises(InputError, match="it moves"):
        rig.system.resume(rig.context)
    rig.set(reported_speed=[0.149])
    rig.advance(0.15 + 2 * PERIOD)
    rig.system.resume(rig.context)


def test_limits_have_their_documented_defaults():
    limits = SafetyLimits(velocity=(1.0,), torque=(1.0,), external_torque=(1.0,))
    assert (limits.force, limits.lower, limits.upper) == (60.0, (-0.2, -0.2, -0.1), (0.2, 0.2, 0.3))
    assert (limits.damping_time, limits.decay_time, limits.ramp_time) == (0.2, 0.02, 0.5)


@pytest.mark.parametrize(
    "arguments",
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
        {"lower": (-np.inf,) * 3},
        {"lower": (-0.2, -0.2), "upper": (0.2, 0.2)},
        {"lower": (-0.2, -0.2)},
        {"upper": (0.2, 0.2, np.inf)},
    ],
)
def test_limits_refuse_values_out_of_range(arguments):
    with pytest.raises(InputError):
        replace(LIMITS, **arguments)


def test_constructor_refuses_limits_of_another_arm(plant):
    with pytest.raises(InputError, match="7 joints"):
        TorqueSafetyLimiter(plant, SafetyLimits((1.0,) * 6, (1.0,) * 6, (1.0,) * 6), period=PERIOD)
    TorqueSafetyLimiter(plant, LIMITS, period=0.5 * LIMITS.decay_time)
    with pytest.raises(InputError, match="decay_time"):
        TorqueSafetyLimiter(plant, LIMITS, period=0.51 * LIMITS.decay_time)
    with pytest.raises(InputError):
        TorqueSafetyLimiter(plant, LIMITS, period=0.0)


def test_values_exactly_at_their_limits_are_no_fault(plant):
    rig = Rig(plant)
    for at_limit in (
        {"estimated_state": [*POSTURE, *[1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0]]},
        {"pose": [*LIMITS.lower, 9.0, 9.0, 9.0], "desired_pose": [*LIMITS.upper, 9.0, 9.0, 9.0]},
        {"pose": [*LIMITS.upper, 9.0, 9.0, 9.0], "desired_pose": [*LIMITS.lower, 9.0, 9.0, 9.0]},
        {"wrench": [0.0, -60.0, 0.0, 99.0, 99.0, 99.0]},
        {"external_torque": [10.0, -10.0] * 3 + [10.0]},
    ):
        rig.set(**at_limit)
        assert rig.fault == Fault.NONE, at_limit


def test_outputs_have_their_sizes_and_direct_feedthrough(plant):
    system = TorqueSafetyLimiter(plant, LIMITS, period=PERIOD)
    outputs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert {port.get_name(): port.size() for port in outputs} == {
        **{"safe_torque": n, "fault": 1, "arm_state": 1, "blend_factor": 1, "is_sending": 1, "is_holding": 1},
        "not_following": 1,
    }
    feedthrough = {
        port.get_name(): {
            system.get_input_port(i).get_name()
            for i in range(system.num_input_ports())
            if system.HasDirectFeedthrough(i, port.get_index())
        }
        for port in outputs
    }
    measured = {"estimated_state", "external_torque", "wrench", "pose", "desired_pose", "torque"}
    assert feedthrough == {
        "safe_torque": measured | {"status_fault", "status_age", "velocity"},
        "fault": measured | {"status_fault", "status_age"},
        "arm_state": set(),
        "blend_factor": set(),
        "is_sending": {"status_fault"},
        "is_holding": measured | {"status_fault", "status_age"},
        "not_following": {"command_timed_out"},
    }


def test_arm_waits_before_the_initialization(plant):
    rig = Rig(plant, running=False)
    assert (rig.arm_state, rig["is_sending"][0], rig["not_following"][0]) == (ArmState.WAITING, 0.0, 1.0)
    np.testing.assert_array_equal(rig["safe_torque"], 0.0)


@pytest.mark.parametrize("time", [None, 0.0])
@pytest.mark.parametrize("arm_state", [ArmState.RAMPING, ArmState.RUNNING])
def test_initialization_stops_an_arm_that_is_controlled(plant, arm_state, time):
    """Without damping torques, the driver could apply the last torque forever."""
    rig = Rig(plant, running=arm_state == ArmState.RUNNING)
    if arm_state == ArmState.RAMPING:
        rig.simulator.Initialize()
        rig.advance(0.5 * LIMITS.ramp_time)
    assert rig.arm_state == arm_state
    rig.context.SetTime(rig.context.get_time() if time is None else time)
    rig.simulator.Initialize()
    assert (rig.arm_state, rig.fault, rig["is_sending"][0]) == (ArmState.DAMPING, Fault.INITIALIZED, 1.0)
    np.testing.assert_allclose(rig["safe_torque"], np.clip(rig.damping(), -20.0, 20.0), atol=1e-12)
    rig.advance(LIMITS.damping_time + 2 * PERIOD)
    assert (rig.arm_state, rig.fault) == (ArmState.OFF, Fault.INITIALIZED)


LARGEST = SPEED.max()
BEFORE = [Fault.STALE, 0.3, 0.0, 0.7, 0.0]  # of a stopped arm, behind its state
START = [ArmState.WAITING, Fault.NONE, 0.0, 0.0, 0.0, 0.0]
CALLS = [
    ("stop", START, [ArmState.OFF, Fault.USER_STOP, np.inf, 0.0, 0.0, 0.0]),
    *(
        ("stop", [state, Fault.NONE, 0.3, 0.5, 0.7, 1.0], [ArmState.DAMPING, Fault.USER_STOP, 0.0, 0.0, LARGEST, 0.0])
        for state in (ArmState.RAMPING, ArmState.RUNNING)
    ),
    *(("stop", [state, *BEFORE], [state, *BEFORE]) for state in (ArmState.DAMPING, ArmState.OFF)),
    *(
        ("damp_again", [state, *BEFORE[:-1], refused], [ArmState.DAMPING, Fault.STALE, 0.0, 0.0, LARGEST, refused])
        for state in (ArmState.DAMPING, ArmState.OFF)
        for refused in (0.0, 1.0)
    ),
    *(("refuse_hold", [state, *BEFORE], [state, *BEFORE[:-1], 1.0]) for state in (ArmState.DAMPING, ArmState.OFF)),
    *(
        (call, [state, Fault.NONE, 0.3, 0.5, 0.7, 0.0], [state, Fault.NONE, 0.3, 0.5, 0.7, 0.0])
        for call in ("damp_again", "refuse_hold")
        for state in (ArmState.WAITING, ArmState.RAMPING, ArmState.RUNNING)
    ),
    ("resume", [ArmState.OFF, Fault.STALE, 0.3, 0.5, 0.7, 1.0], [ArmState.RAMPING, Fault.NONE, 0.0, 0.0, 0.0, 0.0]),
    ("initialize", [ArmState.RUNNING, *BEFORE], [ArmState.DAMPING, Fault.INITIALIZED, 0.0, 0.0, LARGEST, 0.0]),
]


@pytest.mark.parametrize(("call", "before", "after"), CALLS)
def test_state_after_a_call(plant, call, before, after):
    rig = Rig(plant, running=False)
    assert list(rig.state) == START
    rig.context.SetDiscreteState(0, before)
    if call == "initialize":
        rig.simulator.Initialize()
    else:
        getattr(rig.system, call)(rig.context)
    assert list(rig.state) == after


@pytest.mark.parametrize(
    ("velocity", "speed"), [([-0.7, 0.2], 0.7), ([0.2, np.inf], 0.2), ([-np.inf, 0.2], 0.2), ([np.nan, 0.2], 0.2)]
)
def test_speed_of_a_stop_is_the_largest_known_one(plant, velocity, speed):
    rig = Rig(plant)
    rig.set(velocity=[*velocity, *np.zeros(n - 2)])
    rig.system.stop(rig.context)
    assert rig.state[4] == speed


@pytest.mark.parametrize(
    ("initial", "speed", "is_ineffective"),
    [(0.4, 0.2, False), (0.4, 0.2001, True), (0.0, 0.05, False), (0.0, 0.0501, True), (0.4, np.nan, False)],
)
def test_arm_that_its_driver_does_not_hold_is_damped(plant, initial, speed, is_ineffective):
    """An arm must have half of its speed, or 0.05 rad/s, within 50 ms."""
    rig, steps = Rig(plant, can_hold=True), 13
    rig.set(status_fault=[Fault.STALE], velocity=[initial, *np.zeros(n - 1)])
    rig.advance(PERIOD)
    rig.set(reported_speed=[speed], velocity=SPEED)
    rig.advance((steps - 1) * PERIOD)
    assert (steps - 1) * PERIOD < 0.05 <= steps * PERIOD
    assert (rig["is_holding"][0], rig["safe_torque"].any()) == (1.0, False)
    rig.advance(PERIOD)
    state_time, refused = (0.0, 1.0) if is_ineffective else (steps * PERIOD, 0.0)
    assert list(rig.state) == [ArmState.DAMPING, Fault.STALE, state_time, 0.0, initial, refused]
    assert rig["is_holding"][0] == 1.0 - refused
    np.testing.assert_allclose(rig["safe_torque"], refused * np.clip(rig.damping(), -20.0, 20.0), atol=1e-12)


@pytest.mark.parametrize(("time", "is_refused"), [(0.15 - 1e-9, False), (np.nextafter(0.15 - 1e-9, 0.0), True)])
def test_arm_must_be_at_rest_for_the_rest_time(plant, time, is_refused):
    rig = Rig(plant)
    rig.context.SetDiscreteState(0, [ArmState.OFF, *BEFORE])
    rig.context.SetDiscreteState(1, [time])
    with pytest.raises(InputError, match="it moves") if is_refused else contextlib.nullcontext():
        rig.system.resume(rig.context)


@pytest.mark.parametrize(("speed", "rest_time"), [(0.15, 1.0 + PERIOD), (np.nextafter(0.15, 1.0), 0.0)])
@pytest.mark.parametrize("signal", ["velocity", "reported_speed"])
def test_rest_time_begins_again_at_the_rest_speed(plant, signal, speed, rest_time):
    rig = Rig(plant)
    rig.context.SetDiscreteState(1, [1.0])
    rig.set(velocity=np.zeros(n))
    rig.set(**{signal: [speed, *np.zeros(n - 1)] if signal == "velocity" else [speed]})
    rig.advance(PERIOD)
    assert rig.context.get_discrete_state().value(1).item() == rest_time


def test_initialization_continues_a_stop(plant):
    rig = Rig(plant)
    rig.system.stop(rig.context)
    for arm_state in (ArmState.DAMPING, ArmState.OFF):
        rig.simulator.Initialize()
        assert (rig.arm_state, rig.fault, rig["blend_factor"][0]) == (arm_state, Fault.USER_STOP, 0.0)
        rig.advance(LIMITS.damping_time + 2 * PERIOD)


ABOVE = 1.001  # factor of a limit
BEYOND_LIMIT = {
    "velocity": {"estimated_state": [*POSTURE, *SPEED[:-1], ABOVE]},
    "velocity, negative": {"estimated_state": [*POSTURE, -ABOVE, *SPEED[1:]]},
    "external torque": {"external_torque": [-10.0 * ABOVE, *np.zeros(n - 1)]},
    "force": {"wrench": [0.0, 60.0 * ABOVE, 0.0, 0.0, 0.0, 0.0]},
    **{
        f"{port} {name} {axis}": {port: [*(bound * ABOVE if i == axis else 0.0 for i in range(3)), 0.0, 0.0, 0.0]}
        for port in ("pose", "desired_pose")
        for name, corner in (("lower", LIMITS.lower), ("upper", LIMITS.upper))
        for axis, bound in enumerate(corner)
    },
}


@pytest.mark.parametrize("limit", BEYOND_LIMIT)
def test_fault_is_raised_just_beyond_each_limit(plant, limit):
    rig = Rig(plant)
    assert rig.fault == Fault.NONE
    rig.set(**BEYOND_LIMIT[limit])
    name = "workspace" if "pose" in limit else limit.partition(",")[0].replace(" ", "_")
    assert rig.fault == Fault[f"{name}_limit".upper()]


def test_torque_just_beyond_its_limit_is_clipped(plant):
    rig = Rig(plant)
    rig.set(torque=[20.0 * ABOVE, -20.0 * ABOVE, 20.0, -20.0, 19.99, 0.0, 0.0])
    np.testing.assert_array_equal(rig["safe_torque"], [20.0, -20.0, 20.0, -20.0, 19.99, 0.0, 0.0])


@pytest.mark.parametrize("state", [ArmState.DAMPING, ArmState.OFF])
def test_damping_lasts_for_the_damping_time(plant, state):
    """The last damping torque is sent in the step in which the damping time ends."""
    rig, steps = Rig(plant), round(LIMITS.damping_time / PERIOD)
    rig.system.stop(rig.context)
    rig.advance((steps - (state == ArmState.DAMPING)) * PERIOD)
    assert rig.arm_state == state
    assert rig["safe_torque"].any() == (state == ArmState.DAMPING)


@pytest.mark.parametrize(("seconds", "is_sending"), [(0.05, 1.0), (0.05002, 0.0)])
def test_sending_ends_just_after_the_zero_torque_time(plant, seconds, is_sending):
    rig = Rig(plant)
    rig.set(status_fault=[Fault.STALE])
    assert ZERO_TORQUE_TIME == 0.05
    rig.context.SetDiscreteState(0, [ArmState.OFF, Fault.STALE, seconds, 0.0, 0.0, 0.0])
    assert rig["is_sending"][0] == is_sending


@pytest.mark.parametrize("fault", [Fault.FROZEN, Fault.STALE, Fault.CLOCK_RATE, Fault.NO_STATUS])
def test_driver_holds_the_arm_after_a_status_fault(plant, fault):
    rig = Rig(plant, can_hold=True)
    assert rig["is_holding"][0] == 0.0
    rig.set(status_fault=[fault])
    assert rig["is_holding"][0] == 1.0
    rig.advance(PERIOD)
    rig.set(status_fault=[0.0])
    assert (rig["is_holding"][0], rig.arm_state) == (1.0, ArmState.DAMPING)
    rig.set(velocity=np.zeros(len(LIMITS.velocity)))
    rig.advance(LIMITS.damping_time + 2 * PERIOD)
    assert (rig["is_holding"][0], rig.arm_state) == (1.0, ArmState.OFF)
    rig.system.resume(rig.context)
    assert rig["is_holding"][0] == 0.0


@pytest.mark.parametrize("can_hold", [True, False])
def test_driver_does_not_hold_after_another_fault_or_if_waiting(plant, can_hold):
    rig = Rig(plant, can_hold=can_hold)
    rig.set(wrench=[61.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert (rig.fault, rig["is_holding"][0]) == (Fault.FORCE_LIMIT, 0.0)
    rig.advance(PERIOD)
    assert rig["is_holding"][0] == 0.0
    waiting = Rig(plant, running=False, can_hold=can_hold)
    waiting.set(status_fault=[Fault.NO_STATUS])
    waiting.simulator.Initialize()
    assert waiting["is_holding"][0] == 0.0
    cannot_hold = Rig(plant)
    cannot_hold.set(status_fault=[Fault.FROZEN])
    assert cannot_hold["is_holding"][0] == 0.0
