"""Campaign of faults with the driver `ros2`: the robot is a second process, and messages travel over Cyclone DDS.

    python tests/harness/injections/ros2_campaign.py --instants 25 --pairs 200

The second process plays an arm with a Cartesian controller, which follows its last target. Both processes advance in
steps by the same clock, so the speed of the machine does not matter: after each step of the arm, this process waits
until the middleware has delivered every message that was sent. Each kind of fault of `kinds.py` is injected, except
those of LCM's encoding and of the safety monitor. A second robot and a second commander have connections of their own,
and the process of a killed robot ends by SIGKILL and is started again. The requirements are those of `campaign.py`,
except that the loss of commands need not be reported: the arm must come to rest at its last target. The exit code is 1
if a requirement is not met.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from drake import lcmt_iiwa_status
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator

sys.path.insert(0, str(Path(__file__).parents[1]))
from ros2_robot import use_loopback

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.inverse_kinematics import pose_error
from guiderail.systems.support.drake_multibody import pose_to_transform
from guiderail_hardware.drivers import ros2
from guiderail_hardware.drivers.ros2 import Ros2Address, Ros2Bus, Ros2Driver
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.pose_motion_limiter import PoseMotionLimiter
from guiderail_hardware.systems.torque_safety_limiter import STOPPED, ArmState
from injections.campaign import DURATION, MAX_STEPS, SENSITIVITY, SLOW, SLOW_AFTER, Result, has_effect, print_table
from injections.campaign import random_pairs as pairs_of
from injections.kinds import FIELDS, GROWTH, KINDS, NEXT, PERIOD, UNDETECTED, Kind, Q

RADIUS, ROTATION, FREQUENCY = 0.01, 0.15, 1.0  # amplitudes and frequency of the motion [m], [rad], [Hz]
BANDWIDTH = 60.0  # natural frequency of the critically damped arm [rad/s]
SETTLING = 0.4  # time from the start of a motion until the arm follows it [s]
SUBSTEPS = 5  # integration steps of the arm in a period
PATIENCE = 20.0  # longest wait for a message or an answer [s]
POLL = 5e-5  # time between two looks at the arrived messages [s]
HOLD, CONTROLLER, FOREIGN = "hold", "cartesian_controller", "second program"
# Targets of a second program: share of the distance from the arm to the target, and error of the clock [s].
SECOND_PROGRAMS = {
    "second program, torque zero": (0.0, 0.0),
    "second program, torque negated": (-1.0, 0.0),
    "second program, another clock": (-1.0, 40.0),
    "second program, clock + 1 ms": (0.5, 1e-3),
}
NAMES = [f"panda_joint{number}" for number in range(1, 8)]
WITHOUT_DECODING = ("random bytes", "message cut off")  # the middleware decodes messages
WITHOUT_TORQUES = "torques times"  # commands are poses
OTHER_ROBOTS = ("second robot", "moving robot", "resting robot")
# Positions and velocities of this arm differ by about 1 mrad by themselves, so that a slow drift takes longer to show,
# and a wrong position must differ by more to show.
SLOW_DRIFT, SLOW_DRIFT_BOUND = "position drift 9 mrad/s", 0.9
ROS2_SENSITIVITY = {**SENSITIVITY, Q: 2.0 * SENSITIVITY[Q]}


def _latency(kind: Kind) -> float:
    """Return the constant delay of a kind of fault that is not reported [s]; 0 for any other kind."""
    found = re.search(r"(\d+) ms late", kind.name)
    return float(found[1]) / 1000.0 if found and not kind.is_detectable else 0.0


def _is_latency(kind: Kind) -> bool:
    """Return True for a fault that delays all messages by the same time, without a gap that is a timeout."""
    return kind.name.endswith(" ms late") and kind.name != "statuses 60 ms late"


def _lossy(rng: np.random.Generator):
    """Return a fault of a bad network: 10 % are lost, the others are up to 20 ms late and overtake each other."""
    queue: list[tuple[float, int, bytes]] = []

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        if rng.random() >= 0.1:
            queue.append((elapsed + rng.uniform(0.0, 0.02), len(queue), message))
        queue.sort()
        arrived = [late[2] for late in queue if late[0] <= elapsed + 1e-9]
        queue[:] = [late for late in queue if late[0] > elapsed + 1e-9]
        return arrived

    return relay


OWN_KINDS = (
    Kind("statuses: 10 % lost, others late", UNDETECTED, _lossy, "network"),
    Kind("commands: 10 % lost, others late", UNDETECTED, _lossy, "command"),
    Kind("wrenches lost", ros2.MAX_WRENCH_AGE + NEXT, lambda rng: lambda message, elapsed: [message]),
    Kind("joint missing", NEXT, lambda rng: lambda message, elapsed: [message]),
)
# Without a safety monitor at the robot, lost commands are not reported: the controller holds its last target. Nor is a
# constant latency, because the loop of forces is closed at the robot.
SILENT = ("commands lost", "controller killed", "controller stopped")


def _bound(kind: Kind) -> float:
    if kind.name in SILENT or _is_latency(kind):
        return UNDETECTED
    return SLOW_DRIFT_BOUND if kind.name == SLOW_DRIFT else kind.bound


CAMPAIGN = [
    replace(kind, bound=_bound(kind))
    for kind in (*KINDS, *OWN_KINDS)
    if kind.name not in WITHOUT_DECODING and kind.action[1] != "monitor" and not kind.name.startswith(WITHOUT_TORQUES)
]


def is_foreign(target: Any) -> bool:
    """Return True for a target of the second program."""
    return target.header.frame_id == FOREIGN


def to_transform(target: Any) -> RigidTransform:
    """Return the pose of a target."""
    p, q = target.pose.position, target.pose.orientation
    return RigidTransform(RotationMatrix(Quaternion([q.w, q.x, q.y, q.z])), [p.x, p.y, p.z])


class Arm:
    """Robot's side: an arm that follows its last target, with the faults of sensors, network and other programs."""

    def __init__(self, address: str):
        self._bus = Ros2Bus(Ros2Address.parse(address), robot_side=True)
        self._other_robot = Ros2Bus(Ros2Address.parse(address), robot_side=True)
        self._other_commander = Ros2Bus(Ros2Address.parse(address))
        self._model = ArmControllerPlant(BncWorkcell(), "panda")
        self._context = self._model.plant.CreateDefaultContext()
        self.positions, self.velocities = self._model.solve(START, self._model.posture), np.zeros(7)
        self.steps, self._taken, self.num_foreign = 0, 0, 0
        self._target = self._held = self.pose()
        self._before = self.positions, self.velocities
        self._is_holding = True
        self._faults: list[tuple[Kind, Any, int]] = []

    def pose(self) -> RigidTransform:
        """Return the pose of the tool center."""
        self._model.plant.SetPositions(self._context, self.positions)
        return self._model.tool_center.CalcPoseInWorld(self._context)

    def begin(self, names: list[str], seed: list[int]) -> None:
        """Begin faults by name; no names end all faults."""
        rng, kinds = np.random.default_rng(seed), {kind.name: kind for kind in CAMPAIGN}
        self._faults = [(kinds[name], kinds[name].make(rng), self.steps + 1) for name in names if kinds[name].make]

    def step(self, sent: int) -> dict:
        """Advance by a period, after the arrival of `sent` targets in total; return the numbers of sent messages."""
        self.steps += 1
        self._before = self.positions, self.velocities
        effect = self._receive(sent)
        for _ in range(SUBSTEPS):
            self._integrate(PERIOD / SUBSTEPS)
        joints, wrenches, changed = self._publish()
        return {
            "joints": joints, "wrenches": wrenches, "foreign": self.num_foreign, "effect": effect or changed,
            "speed": self.speed,
        }  # fmt: skip

    @property
    def speed(self) -> float:
        """Speed of the fastest joint [rad/s]."""
        return float(np.abs(self.velocities).max())

    def predict(self, targets: list[list[float]]) -> list[float]:
        """Return the speed of the fastest joint in the last step and the next ones, if it follows targets (n, 7)."""
        now = self.positions, self.velocities, self._target
        self.positions, self.velocities = self._before
        speeds = []
        for target in targets:
            self._target = RigidTransform(RotationMatrix(Quaternion(target[3:])), target[:3])
            for _ in range(SUBSTEPS):
                self._integrate(PERIOD / SUBSTEPS)
            speeds.append(self.speed)
        self.positions, self.velocities, self._target = now
        return speeds

    def _since(self, start: int) -> float:
        return (self.steps - start) * PERIOD

    def serve(self) -> None:
        """Answer the requests to switch controllers; without the Cartesian controller, targets have no effect."""
        for request in self._bus.take(self._bus.requests):
            self._is_holding = HOLD in request.activate_controllers
            self._target = self._held = self.pose()
            response = self._bus.messages.SwitchControllerResponse(request.guid, request.number, True, "")
            self._bus.responses.write(response)

    def greet(self) -> int:
        """Send a message on each connection, and return the number of targets of the other process that arrived."""
        for bus in (self._bus, self._other_robot):
            bus.joints.write(bus.messages.JointState(self._header(0.0), [], [], [], []))
            bus.wrench.write(bus.messages.WrenchStamped(self._header(0.0)))
        self._command_too(self._header(0.0))
        self.num_foreign = 0
        return sum(not is_foreign(sample) for sample in self._bus.take(self._bus.targets))

    def _receive(self, sent: int) -> bool:
        """Follow the last target that arrives of those that were sent; return True if a fault had an effect."""
        end, targets = time.monotonic() + PATIENCE, []
        while self._taken < sent:
            own = [sample for sample in self._bus.take(self._bus.targets) if not is_foreign(sample)]
            targets += own
            self._taken += len(own)
            if time.monotonic() > end:
                raise SystemExit(f"{self._taken} of {sent} targets arrived")
            if self._taken < sent:
                time.sleep(POLL)
        self.serve()
        effect = False
        for kind, fault, start in self._faults:
            if kind.name.startswith("second program"):
                continue
            if kind.where == "command":
                relayed = [out for target in targets for out in fault(target, self._since(start))]
                effect |= relayed != targets
                targets = relayed
        if targets:
            self._target = to_transform(targets[-1])
        for kind, *_ in self._faults:
            if kind.name in SECOND_PROGRAMS:
                share, offset = SECOND_PROGRAMS[kind.name]
                self._target, effect = self._toward(share), True
                self._command_too(self._header(self.steps * PERIOD + offset))
        if self._is_holding:
            self._target = self._held
        return effect

    def _toward(self, share: float) -> RigidTransform:
        """Return a pose between the arm's pose and its target; a negative share is on the other side of the arm."""
        X = self.pose()
        p = X.translation()
        return RigidTransform(X.rotation(), p + share * (self._target.translation() - p))

    def _command_too(self, header: Any) -> None:
        """Send the present target as a second program, on a connection of its own."""
        messages, X = self._bus.messages, self._target
        header.frame_id = FOREIGN
        p, q = X.translation(), X.rotation().ToQuaternion()
        pose = messages.Pose(messages.Point(*p.tolist()), messages.Quaternion(q.x(), q.y(), q.z(), q.w()))
        self._other_commander.target.write(messages.PoseStamped(header, pose))
        self.num_foreign += 1

    def _integrate(self, step: float) -> None:
        error = pose_error(self._target, self.pose())
        plant, world = self._model.plant, self._model.plant.world_frame()
        J = plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._model.tool_center, np.zeros(3), world, world
        )
        acceleration = BANDWIDTH**2 * np.linalg.pinv(J) @ error - 2.0 * BANDWIDTH * self.velocities
        self.velocities = self.velocities + step * acceleration
        self.positions = self.positions + step * self.velocities

    def _header(self, seconds: float) -> Any:
        messages = self._bus.messages
        return messages.Header(messages.Time(int(seconds // 1), int(1e9 * (seconds % 1.0))), "base")

    def _publish(self) -> tuple[int, int, bool]:
        """Send joint states and wrenches; return their numbers, and whether a fault had an effect."""
        status = lcmt_iiwa_status()
        status.utime, status.num_joints = 1_000_000_000 + round(1e6 * self.steps * PERIOD), 7
        for field in FIELDS:
            setattr(status, field, [0.0] * 7)
        status.joint_position_measured = self.positions.tolist()
        status.joint_velocity_estimated = self.velocities.tolist()
        message, effect = status.encode(), False
        relayed: list[tuple[bytes, bool]] = [(message, False)]
        for kind, fault, start in self._faults:
            if kind.where not in ("sensor", "network"):
                continue
            changed = []
            for each, is_other in relayed:
                for out in fault(each, self._since(start)):
                    changed.append((out, is_other or (out != each and kind.name.startswith(OTHER_ROBOTS))))
            effect |= kind in OWN_KINDS or has_effect(
                message, [out for out, _ in changed], kind.where, ROS2_SENSITIVITY
            )
            relayed = changed
        names = {kind.name for kind, _, _ in self._faults}
        for content, is_other in relayed:
            bus = self._other_robot if is_other else self._bus
            self._send(bus, lcmt_iiwa_status.decode(content), names)
        return len(relayed), 0 if "wrenches lost" in names else len(relayed), effect

    def _send(self, bus: Ros2Bus, status: lcmt_iiwa_status, faults: set[str]) -> None:
        messages, header = bus.messages, self._header(1e-6 * status.utime)
        wrench = np.zeros(6)
        for index, value in enumerate(status.joint_torque_external):
            wrench[index % 6] += value
        if "wrenches lost" not in faults:
            force, torque = messages.Vector3(*wrench[:3].tolist()), messages.Vector3(*wrench[3:].tolist())
            bus.wrench.write(messages.WrenchStamped(header, messages.Wrench(force, torque)))
        names = [*NAMES, *(f"other{number}" for number in range(7))][: status.num_joints]
        q, v = list(status.joint_position_measured), list(status.joint_velocity_estimated)
        if "joint missing" in faults:
            names, q, v = names[:-1], q[:-1], v[:-1]
        bus.joints.write(messages.JointState(header, names, q, v, []))


def play_arm(address: str) -> None:
    """Answer a line of JSON for each line on the standard input."""
    arm = Arm(address)
    for line in sys.stdin:
        request = json.loads(line)
        answer: dict = {}
        if request["do"] == "begin":
            arm.begin(request["kinds"], request["seed"])
        elif request["do"] == "step":
            answer = arm.step(request["sent"])
        elif request["do"] == "predict":
            answer = {"speeds": arm.predict(request["targets"])}
        elif request["do"] == "greet":
            answer = {"arrived": arm.greet()}
        else:
            arm.serve()
        print(json.dumps(answer), flush=True)


class CountingBus(Ros2Bus):
    """Connection of the driver that waits until every message that was sent has arrived.

    Attributes:
        expected: Numbers of joint states, wrenches and foreign targets that were sent.
        sent: Number of targets that this bus has sent.
    """

    def __init__(self, address: Ros2Address):
        super().__init__(address)
        self._readers = {"joints": self.joints, "wrenches": self.wrench, "foreign": self.targets}
        self.expected = dict.fromkeys(self._readers, 0)
        self._counts = dict.fromkeys(self._readers, 0)
        self._arrived: dict[str, list[Any]] = {name: [] for name in self._readers}
        self.sent, self.writer = 0, self.target
        self.target = SimpleNamespace(write=self._write, instance_handle=self.writer.instance_handle)

    def _write(self, message: Any) -> None:
        self.sent += 1
        self.writer.write(message)

    def wait(self) -> None:
        """Wait until the expected messages have arrived."""
        end = time.monotonic() + PATIENCE
        while True:
            for name, reader in self._readers.items():
                samples = Ros2Bus.take(reader)
                self._arrived[name] += samples
                self._counts[name] += len(samples) if name != "foreign" else sum(map(is_foreign, samples))
            if all(self._counts[name] >= self.expected[name] for name in self._readers):
                return
            if time.monotonic() > end:
                raise SystemExit(f"{self._counts} of {self.expected} messages arrived")
            time.sleep(POLL)

    def take(self, reader: Any) -> list[Any]:
        """Return the messages that have arrived, oldest first."""
        for name, known in self._readers.items():
            if reader is known:
                arrived, self._arrived[name] = self._arrived[name], []
                return arrived
        return Ros2Bus.take(reader)


class Campaign:
    """Hardware station with the driver `ros2`, and the process that plays the arm."""

    def __init__(self, domain: int):
        self.address = f"{domain}?controller={CONTROLLER}&hold={HOLD}"
        self.arm = subprocess.Popen(
            [sys.executable, __file__, "--play", self.address], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.step, self.speed, self.has_effect = 0, 0.0, False
        self.has_robot = self.has_controller = True
        ros2.clock = SimpleNamespace(monotonic=self.now, time=self.now, sleep=lambda seconds: self.ask(do="serve"))
        self.bus = CountingBus(Ros2Address.parse(self.address))
        self._connect()
        self.station = HardwareStation(
            BncWorkcell(), Ros2Driver(self.address, bus=self.bus), robot="panda", robot_timeout=1.0
        )
        plant = self.station.controller_plant.plant
        self.X_BaseTarget = self.station.controller_plant.target.CalcPoseInWorld(plant.CreateDefaultContext())
        self.limiter = PoseMotionLimiter(Ros2Driver.motion_limits, period=PERIOD)
        self.limiter_states: deque[np.ndarray] = deque(maxlen=2)  # before each of the last two steps
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.station.get_desired_pose_input_port().FixValue(self.context, self.desired(self.step))
        self._step_arm()
        self.station.start(self.simulator)

    def now(self) -> float:
        """Return the common clock [s]."""
        return self.step * PERIOD

    def ask(self, **request: Any) -> dict:
        """Return the arm's answer to a request."""
        self.arm.stdin.write(json.dumps(request) + "\n")
        self.arm.stdin.flush()
        return json.loads(self.arm.stdout.readline())

    def _connect(self) -> None:
        """Exchange messages until every connection is known to the other process."""
        self.ask(do="greet")  # the other process has started
        end, missing = time.monotonic() + PATIENCE, True
        while missing:
            self.bus.writer.write(self.bus.messages.PoseStamped())
            missing = self.ask(do="greet")["arrived"] == 0
            time.sleep(0.1)
            joints, wrenches, targets = map(Ros2Bus.take, (self.bus.joints, self.bus.wrench, self.bus.targets))
            missing |= len(joints) < 2 or len(wrenches) < 2 or not any(map(is_foreign, targets))
            if time.monotonic() > end:
                raise SystemExit("the two processes do not find each other")
        time.sleep(0.2)
        self.ask(do="greet")
        time.sleep(0.2)
        for reader in (self.bus.joints, self.bus.wrench, self.bus.targets):
            Ros2Bus.take(reader)

    def _step_arm(self) -> None:
        answer = self.ask(do="step", sent=self.bus.sent)
        for name in ("joints", "wrenches"):
            self.bus.expected[name] += answer[name]
        self.bus.expected["foreign"] = answer["foreign"]
        self.speed, self.has_effect = answer["speed"], answer["effect"]
        self.bus.wait()

    def step_once(self) -> None:
        """Advance both processes by a period."""
        limiter = self.station.GetSubsystemByName("rate_limiter")
        state = limiter.GetMyContextFromRoot(self.context).get_discrete_state_vector().CopyToVector()
        self.limiter_states.append(state)
        self.step += 1
        if self.has_robot:
            self._step_arm()
        if self.has_controller:
            self.station.get_desired_pose_input_port().FixValue(self.context, self.desired(self.step))
            self.simulator.AdvancePendingEvents()
            self.station.receive(self.context, self.now())
            self.simulator.AdvanceTo(self.context.get_time() + PERIOD)

    def desired(self, step: int) -> np.ndarray:
        """Return the desired pose in a step: on a circle, with an oscillating rotation."""
        phase = 2.0 * np.pi * FREQUENCY * step * PERIOD
        return START + [RADIUS * np.cos(phase), RADIUS * np.sin(phase), 0.0, ROTATION * np.sin(phase), 0.0, 0.0]

    @property
    def arm_state(self) -> ArmState:
        """The station's arm state."""
        return ArmState(int(self.station.get_arm_state_output_port().Eval(self.context)[0]))

    @property
    def fault(self) -> Fault:
        """The station's fault."""
        return Fault(int(self.station.get_fault_output_port().Eval(self.context)[0]))

    @property
    def is_detected(self) -> bool:
        """True if the station is stopping the arm."""
        return self.has_controller and (self.arm_state in STOPPED or self.fault != Fault.NONE)

    def run_until_following(self) -> None:
        """Advance until the arm follows its command, and resume it when it is stopped."""
        for _ in range(round(8.0 / PERIOD)):  # a drift of a position is forgotten in seconds
            if self.arm_state == ArmState.RUNNING and self.fault == Fault.NONE:
                break
            if self.arm_state == ArmState.OFF:
                with contextlib.suppress(InputError):  # the fault persists
                    self.station.resume(self.context)
            self.step_once()
        else:
            raise AssertionError(f"does not resume: {self.arm_state.name}, {self.fault.name}")

    def run_undisturbed(self, seconds: float) -> None:
        """Advance until the arm has followed its command for `SETTLING`, and for a time [s]."""
        number = 0
        while number < round((SETTLING + seconds) / PERIOD):
            if self.is_detected:
                number = 0
                self.run_until_following()
            self.step_once()
            number += 1

    def predict_speed(self, steps: int) -> float:
        """Return the largest speed of a joint in the last step and the next ones if there were no fault [rad/s].

        The speed changes from one period of the motion to the next, because the limiter of the desired poses does not
        follow it exactly. The limiter's targets depend on the desired poses only, and are computed ahead.
        """
        limiter, ahead, first = self.limiter, [], self.step - 1
        context = limiter.CreateDefaultContext()
        context.SetDiscreteState(self.limiter_states[0])
        limiter.get_blend_factor_input_port().FixValue(context, [1.0])
        limiter.get_pose_input_port().FixValue(context, self.desired(first))  # not used while the arm is controlled
        for step in range(first, first + steps):
            limiter.get_desired_pose_input_port().FixValue(context, self.desired(step))
            X = self.X_BaseTarget @ pose_to_transform(limiter.get_limited_pose_output_port().Eval(context))
            ahead.append([*X.translation().tolist(), *X.rotation().ToQuaternion().wxyz().tolist()])
            context.SetDiscreteState(limiter.EvalUniquePeriodicDiscreteUpdate(context).value().copy())
        return max(self.ask(do="predict", targets=ahead)["speeds"])

    def inject(self, kinds: tuple[Kind, ...], seed: list[int]) -> Result:
        """Inject one or more faults at the same time, and observe the arm for at least `DURATION`."""
        result, first_step, start = Result(np.nan, "", 0.0, 0.0, []), self.step, None
        bound = max((kind.bound for kind in kinds if kind.is_detectable), default=np.nan)
        bound += sum(map(_latency, kinds))  # a fault cannot be seen before its status arrives
        self.ask(do="begin", kinds=[kind.name for kind in kinds], seed=seed)
        programs = {kind.action for kind in kinds if kind.make is None}
        for action, program in programs:
            if program == "robot":
                self.arm.send_signal(signal.SIGKILL if action == "kill" else signal.SIGSTOP)
            setattr(self, f"has_{program}", False)
        if programs:
            start = self.step
        reach = round((bound if np.isfinite(bound) else DURATION) / PERIOD) + 4
        speed, elapsed = 0.0, 0.0
        duration = max(DURATION, np.nan_to_num(bound) + SLOW_AFTER)
        while elapsed < duration - 1e-9 and self.step - first_step < MAX_STEPS:
            before = self.speed
            self.step_once()
            if start is None and self.has_effect:
                start = self.step - 1
            if start is not None and speed == 0.0:
                speed = max(before, self.predict_speed(reach)) if self.has_robot else before
            elapsed = 0.0 if start is None else (self.step - start) * PERIOD
            if np.isnan(result.detected) and self.is_detected:
                result.detected, result.cause = elapsed, self.fault.name
            if self.has_robot and start is not None:
                result.growth = max(result.growth, self.speed / speed)
                # A fault with a longer bound than `SLOW_AFTER` has no effect until its detection.
                if elapsed - (result.detected if bound > SLOW_AFTER else 0.0) > SLOW_AFTER - 1e-9:
                    result.late_speed = max(result.late_speed, self.speed)
        self._end(programs)
        # A program that does not run detects nothing.
        has_run = "controller" not in {program for _, program in programs}
        is_detectable = any(kind.is_detectable for kind in kinds) and start is not None and has_run
        if is_detectable and not result.detected <= bound + 1e-9:
            result.failures.append(f"detected after {1000.0 * result.detected:.0f} ms")
        is_silent = any(kind.name in SILENT for kind in kinds)
        if (is_detectable or is_silent) and result.late_speed >= SLOW:
            result.failures.append(f"{result.late_speed:.2f} rad/s after {SLOW_AFTER} s")
        if (is_detectable or is_silent or any(map(_is_latency, kinds))) and result.growth > GROWTH:
            result.failures.append(f"{result.growth:.2f} times as fast")
        return result

    def _end(self, programs: set[tuple[str, str]]) -> None:
        """End all faults."""
        if ("kill", "robot") in programs:
            self.arm.wait()
            return
        if ("stop", "robot") in programs:
            self.arm.send_signal(signal.SIGCONT)
        self.has_robot = self.has_controller = True
        self.ask(do="begin", kinds=[], seed=[0])

    def close(self) -> None:
        """End the arm's process."""
        self.arm.kill()
        self.arm.wait()


def main() -> int:
    """Run the campaign; return 1 if a requirement was not met, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instants", type=int, default=25, help="instants for each kind of fault")
    parser.add_argument("--pairs", type=int, default=200, help="pairs of faults that begin together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", help="names of kinds (default: all)")
    parser.add_argument("--play", metavar="ADDRESS", help="play the arm at an address")
    arguments = parser.parse_args()
    if arguments.play:
        play_arm(arguments.play)
        return 0
    use_loopback()
    started, domains = time.monotonic(), itertools.cycle(range(20 + os.getpid() % 100, 230))
    campaign, last = Campaign(next(domains)), Result(np.nan, "", 0.0, 0.0, [])
    kinds = [kind for kind in CAMPAIGN if not arguments.kinds or kind.name in arguments.kinds]
    results: dict[str, list[Result]] = {kind.name: [] for kind in kinds}
    for instant in range(arguments.instants):
        rng = np.random.default_rng([arguments.seed, instant])
        injections = [(kind,) for kind in kinds]
        injections += list(pairs_of(kinds, arguments.pairs // arguments.instants, rng))
        for number, chosen in enumerate(injections):
            wait = float(rng.uniform(0.02, 0.3))
            try:
                campaign.run_undisturbed(wait)
            except AssertionError as error:
                last.failures.append(str(error))
                print(f"FAIL  after the fault before: {error}", flush=True)
                campaign.close()
                campaign = Campaign(next(domains))
                campaign.run_undisturbed(wait)
            last = result = campaign.inject(chosen, [arguments.seed, instant, number])
            if campaign.arm.poll() is not None:  # killed; its connections stay known for a while
                campaign = Campaign(next(domains))
            results.setdefault(chosen[0].name if len(chosen) == 1 else "pairs", []).append(result)
            for failure in result.failures:
                name = " and ".join(kind.name for kind in chosen)
                print(f"FAIL  {name}, instant {instant}: {failure} ({result.cause})", flush=True)
        print(f"instant {instant} is done", flush=True)
    campaign.close()
    failed = print_table(results, CAMPAIGN)
    total = sum(len(rows) for rows in results.values())
    print(f"{total} injections, {failed} with a failed requirement, in {time.monotonic() - started:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
