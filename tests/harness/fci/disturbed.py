"""Training and evaluation on a simulated Franka that is killed, or whose references are delayed.

    python tests/harness/fci/disturbed.py train runs/franka --episodes 40 --kill-after 300 700
    python tests/harness/fci/disturbed.py evaluate runs/franka --episodes 20 --jitter 0.02

A killed robot is restarted at the initial pose, with its clock at zero. References are sent at 100 Hz, and each arrives
after a random delay up to the jitter. A reference that arrives after a later one is dropped.
"""

from __future__ import annotations

import argparse
import json
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail_hardware.drivers.fci import FciDriver
from guiderail_hardware.robot.connection import RobotConnection
from guiderail_hardware.robot.robot_evaluation import evaluate_on_robot
from guiderail_hardware.robot.robot_training import train_on_robot

REFERENCE_PERIOD = 0.01  # period of the references [s]
FORCE_LIMIT = 20.0  # force limit [N]; contact at the default of 35 N can exceed the limits of external joint torques


@dataclass(frozen=True)
class KilledRobot(RobotConnection):
    """Connection to a simulated robot whose process is killed and restarted.

    Args:
        kill_after: Times after the start at which the process is killed, by the wall clock [s].
    """

    kill_after: tuple[float, ...] = ()

    @contextmanager
    def simulated_driver(self, task: str, url: str, imports: Sequence[str] = ()) -> Iterator[None]:
        """Run the simulated driver; each restart of the robot is a new child process."""
        is_ended, start = threading.Event(), time.monotonic()

        def run_robot() -> None:
            for end in (*self.kill_after, np.inf):
                with super(KilledRobot, self).simulated_driver(task, url, imports) as process:
                    is_ended.wait(None if end == np.inf else max(0.0, start + end - time.monotonic()))
                    process.kill()
                if is_ended.is_set():
                    return
                print(f"robot killed after {end:.0f} s", flush=True)

        thread = threading.Thread(target=run_robot)
        thread.start()
        try:
            yield
        finally:
            is_ended.set()
            thread.join()


def delay_references(jitter: float) -> None:
    """Delay the references of every `FciDriver` by a random time of at most `jitter` [s]."""
    rng, send = np.random.default_rng(0), FciDriver.write_pose
    queue: list[tuple[float, float, RigidTransform]] = []  # time of sending, time of arrival, pose
    last = -np.inf

    def write_pose(driver: FciDriver, X_BaseTool: RigidTransform, now: float) -> None:
        nonlocal last, queue
        if now < last:  # the time of each simulator begins at zero
            queue, last = [], -np.inf
        if now - last > REFERENCE_PERIOD - 1e-6:
            last = now
            queue.append((now, now + rng.uniform(0.0, jitter), X_BaseTool))
        arrived = [sent for sent, arrival, _ in queue if arrival <= now + 1e-6]
        if arrived:
            newest = next(pose for sent, _, pose in queue if sent == max(arrived))
            queue = [reference for reference in queue if reference[0] > max(arrived)]
            send(driver, newest, now)

    setattr(FciDriver, "write_pose", write_pose)  # noqa: B010


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["train", "evaluate"])
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("--episodes", type=int, required=True)
    parser.add_argument("--seed", type=int, default=30, help="seed of the training")
    parser.add_argument(
        "--kill-after", type=float, nargs="*", default=(), help="times at which the robot is killed [s]"
    )
    parser.add_argument("--jitter", type=float, default=None, help="longest delay of a reference [s]")
    parser.add_argument("--joint-friction", type=float, help="friction of each joint of the robot [Nm]")
    parser.add_argument("--out", type=Path, help="folder of the evaluation")
    arguments = parser.parse_args()
    if arguments.jitter is not None:
        delay_references(arguments.jitter)
    connection = KilledRobot(
        robot="panda",
        driver="fci",
        sim=True,
        joint_friction=arguments.joint_friction,
        kill_after=tuple(arguments.kill_after),
    )
    result: Any
    if arguments.command == "train":
        environment: dict[str, Any] = {"station": "hardware", "guidance": "kgrl", "reward": "shaped"}
        environment |= {"fixture_offset": "per_run", "force_limit": FORCE_LIMIT}
        given = {"episodes": arguments.episodes, "seed": arguments.seed}
        result = train_on_robot(
            "BncConnector", arguments.run, connection, environment=environment, given=given, assume_yes=True
        )
    else:
        result = evaluate_on_robot(arguments.run, connection, arguments.episodes, assume_yes=True, out=arguments.out)
    print(json.dumps(dict(result), default=float))


if __name__ == "__main__":
    main()
