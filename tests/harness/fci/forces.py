"""Adversarial references against the force limit of a simulated Franka over its own protocol.

    python tests/harness/fci/forces.py --steps 20000  # half an hour

A round has a force limit, a friction of the joints, a contact and a robot process. Its references lie anywhere in the
box of `force_adversary.Anywhere` around a pose above the connector: random, held, at the corners, and bang-bang. The
contact is MuJoCo's own, or softer. The robot records the force of its commanded torques and the contact's force in
every step of the engine, a quarter of a millisecond. Contact forces are less what the joints'
friction holds, relative to the limit. A stop is counted, and its forces in the control step in which it begins; then
the motion is resumed, or the round ends.

The output is a table (CSV) with a row for each round. The exit code is 1 if a contact force exceeded its bound, see
docs/concepts/forces.md. The impedance's force has no bound here: between two references, the robot moves.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import tempfile
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from franky_sim.mujoco_simulator import MujocoSimulator
from scipy.ndimage import minimum_filter1d
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).parents[1]))
from fci.simulated_franka import STATUSES_PER_STEP, SimulatedRun
from force_adversary import ATTACKS, REACH, attack, friction_force, mujoco_bound, mujoco_damping, transient_bound

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.diagrams.tasks.insertion import part_poses
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import FORCE_SHARES
from guiderail_hardware.drivers.fci import FciDriver
from guiderail_hardware.drivers.fci_simulated import ROBOT, STEP, SUBSTEPS, SimulatedFranka, WorkcellSimulator, serve
from guiderail_hardware.robot.connection import subprocess_tied_to_parent
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import tool_jacobian
from guiderail_hardware.systems.torque_safety_limiter import ArmState
from guiderail_mujoco.station import MujocoContact, constraint_torques

LIMITS, FRICTIONS = (8.0, 15.0, 20.0), (0.0, 0.3, 0.7)  # [N], of each joint [Nm]
# Measured stiffness of the contact with the rim [N/mm], and the factor of the stiffness of MuJoCo's own contact for it.
CONTACTS = {4345: 1.0, 611: 7.4e-4, 141: 1e-4}
CENTER = START - np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])  # of the references, above the rim
HOLDS, ATTACK_STEPS = (5, 20, 75), 150  # numbers of control steps of a reference and of an attack
FILTER_TIME, LASTING = 0.01, 0.5  # time constant of filtered forces [s]; duration of a quasi-static contact [s]
# Moving mass of the simulated arm at the tool, the smallest and the largest in any direction [kg], and its largest
# ratio to the mass in the controller's model, which has a quarter of the rotors' inertia.
MASS, LARGEST_MASS, MASS_RATIO = 1.68, 9.3, 1.45
DELAY = 0.006  # period of the station, and of the robot's loop [s]


@dataclass
class Round:
    """Statistics of a round; contact forces are less what the joints' friction holds, relative to the limit."""

    number: int
    limit: float
    joint_friction: float
    stiffness: int  # of the contact [N/mm]
    control_steps: int = 0
    stops: int = 0
    fault: str = ""  # reason of the last stop
    impedance: float = 0.0  # force of the commanded torques, relative to the limit
    filtered: float = 0.0  # contact force, filtered with 10 ms
    quasi_static: float = 0.0  # filtered contact force that lasts 0.5 s
    quasi_static_bound: float = round(math.hypot(*FORCE_SHARES), 3)
    transient: float = 0.0  # contact force in a single step of the engine
    transient_bound: float = 0.0

    def __post_init__(self) -> None:
        if CONTACTS[self.stiffness] == 1.0:
            contact = MujocoContact(time_step=STEP / SUBSTEPS)
            bound = mujoco_bound(1.0, LARGEST_MASS * MASS_RATIO, contact) + DELAY * mujoco_damping(contact)
        else:  # a larger mass acts like a stiffer contact
            bound = transient_bound(1e3 * self.stiffness * MASS_RATIO, MASS * MASS_RATIO, DELAY, 1.0)
        self.transient_bound = round(bound, 2)

    def add(self, records: np.ndarray, held: float) -> None:
        """Add contiguous records (n, 4) of the robot's steps; friction holds the force `held` [N]."""
        decay, window = STEP / SUBSTEPS / FILTER_TIME, round(LASTING * SUBSTEPS / STEP)
        force = np.linalg.norm(records[:, 1:], axis=1)
        filtered = np.linalg.norm(lfilter([decay], [1.0, decay - 1.0], records[:, 1:], axis=0), axis=1)
        lasting = minimum_filter1d(filtered, window)[window // 2 : max(len(force) - window // 2, 0)]
        self.impedance = max(self.impedance, round(records[:, 0].max() / self.limit, 3))
        for name, forces in (("transient", force), ("filtered", filtered), ("quasi_static", lasting)):
            setattr(self, name, max(getattr(self, name), round((forces.max(initial=0.0) - held) / self.limit, 3)))


class RecordingSimulator(WorkcellSimulator):
    """Simulator that appends the forces of each engine step to a file; `modulus` scales the contacts' stiffness."""

    def __init__(self, path: str, joint_friction: float, modulus: float):
        super().__init__(BncWorkcell(), joint_friction)
        self._path, self._modulus, self._command = Path(path), modulus, np.zeros(7)

    def _start(self) -> None:
        super()._start()
        self.model.geom_solref[:, 0] /= math.sqrt(self._modulus)

    def add_arm(self, pose: np.ndarray) -> SimulatedFranka:
        """Add the robot and the parts, as a `WorkcellSimulator`; the robot's commands are recorded."""
        arm = super().add_arm(pose)
        control = arm.torque_control

        def torque_control(torques: Any, has_new_command: bool = True) -> None:
            self._command = np.asarray(torques, dtype=float)
            control(torques, has_new_command)

        arm.torque_control = torque_control
        return arm

    def _step(self) -> None:
        assert self._arm is not None
        records = []
        for _ in range(SUBSTEPS):
            MujocoSimulator._step(self)
            self._arm.add_contact()
            records.append(self._record(self._arm._dof_addrs))
        with self._path.open("ab") as file:
            file.write(np.array(records).tobytes())

    def _record(self, dofs: Any) -> np.ndarray:
        """Return the norm of the commanded force and the contact's force [N], (4,)."""
        model, data, jacobian = self.model, self.data, np.zeros((6, self.model.nv))
        link = model.body(ROBOT + "fr3_link7").id
        point = data.xpos[link] + data.xmat[link].reshape(3, 3) @ self._X_LinkTool.translation()
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], point, link)
        J, torques = jacobian[:, dofs], np.stack([self._command, constraint_torques(model, data)[dofs]], axis=1)
        command, contact = np.linalg.solve(J @ J.T, J @ torques)[:3].T
        return np.array([np.linalg.norm(command), *contact])


def simulate(host: str, path: str, joint_friction: float, modulus: float) -> None:
    """Run the simulated robot; its forces are appended to the file `path`."""
    parts = part_poses(np.zeros(2), np.zeros(2))
    serve(RecordingSimulator(path, joint_friction, modulus), START, parts, 1e5, host=host, log=lambda _: None)


class Unlimited(FciDriver):
    """Driver whose robot follows the desired poses with its spring, at any approach speed."""

    is_spring_and_damper = False


def run_round(row: Round, steps: int, driver: type[FciDriver]) -> None:
    """Run attacks for at least `steps` control steps, or until a stop that cannot be ended, and add them to a round."""
    run, rng = SimulatedRun(driver, row.limit), np.random.default_rng(row.number)
    model, period = run.station.controller_plant, STATUSES_PER_STEP * run.station.period
    held = friction_force(tool_jacobian(model, model.posture, model.target)[3:], row.joint_friction)
    with tempfile.NamedTemporaryFile() as file:
        code = f"import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r}); from fci.forces import simulate\n"
        code += f"simulate({run.host!r}, {file.name!r}, {row.joint_friction}, {CONTACTS[row.stiffness]})"
        with subprocess_tied_to_parent(code):
            run.start()
            run.advance(1.2)
            file.read()
            attacks = (attack(kind, rng, len(REACH)) for kind in itertools.cycle(ATTACKS))
            while row.control_steps < steps:
                act, hold = next(attacks), int(rng.choice(HOLDS))
                for step in range(ATTACK_STEPS):
                    if step % hold == 0:
                        run.pose = CENTER + REACH * act()
                    run.advance(period)
                    row.control_steps += 1
                    if run["arm_state"][0] != ArmState.RUNNING:
                        break
                row.add(np.frombuffer(file.read()).reshape(-1, 4), held)
                if run["arm_state"][0] != ArmState.RUNNING:
                    row.stops, row.fault = row.stops + 1, run.describe().partition(";")[0].replace(",", ":")
                    try:
                        run.station.driver.recover()
                        run.clock.begin()
                        run.resume()
                    except InputError:
                        return
                    file.read()  # without the forces of the stopped arm


def main() -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="control steps of all rounds together")
    parser.add_argument("--round", type=int, default=750, help="control steps of a round")
    parser.add_argument("--first", type=int, default=0, help="number of the first round, the seed of its references")
    parser.add_argument("--unlimited", action="store_true", help="without the limit of the approach speed")
    args = parser.parse_args()
    conditions, done, failures = list(itertools.product(LIMITS, FRICTIONS, CONTACTS)), 0, 0
    print(",".join(entry.name for entry in fields(Round)), flush=True)
    for number in itertools.count(args.first):
        row = Round(number, *conditions[7 * number % len(conditions)])
        run_round(row, min(args.round, args.steps - done), Unlimited if args.unlimited else FciDriver)
        print(",".join(map(str, astuple(row))), flush=True)
        done += row.control_steps
        failures += row.transient > row.transient_bound or row.quasi_static > row.quasi_static_bound + 1e-3
        if done >= args.steps:
            break
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
