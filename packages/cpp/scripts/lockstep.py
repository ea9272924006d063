"""Compare a policy in Python with its exported C++ program on held-out episodes, each against the simulator.

    guiderail export pretrained:connector --target cpp --out connector
    cmake -S connector -B connector/build && cmake --build connector/build
    python packages/cpp/scripts/lockstep.py pretrained:connector connector --episodes 100

The program computes observation, action and command of each control step from the measured pose and wrench, over a
socket, while the simulator waits. It evaluates the network in double precision, but a policy in Python rounds to single
precision. The first `--double` episodes therefore run a third time, in Python with the network in double precision. The
exit status is 0 if every episode has the same outcome.
"""

import argparse
import json
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from guiderail import register_guidance
from guiderail.models.laws import Law
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.rollout import Paths, rollout
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run
from guiderail_cpp.recording import double_action

OUTCOME = ("success", "termination", "steps")


class Program:
    """Connection to the program `lockstep`."""

    def __init__(self, folder: Path):
        self._signals = json.loads((folder / "skill.json").read_text())["signals"]
        command = [folder / "build/lockstep", folder / "skill.safetensors"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._socket = socket.create_connection(("127.0.0.1", int(self._process.stdout.readline())))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._num_steps, self._last = 0, np.zeros(0)

    def start(self, pose: np.ndarray) -> None:
        """Begin an episode at a measured pose; the command is that for an action of zero."""
        self._num_steps, self._last = 0, self._ask(True, pose, np.zeros(0))

    def command(self, step: int, pose: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        """Return the command of a control step; the program takes each step once, and answers repeated questions."""
        if step == self._num_steps:
            self._num_steps, self._last = step + 1, self._ask(False, pose, wrench)
        elif step != self._num_steps - 1:
            raise RuntimeError(f"the simulator asks for step {step} after step {self._num_steps - 1}")
        return self._last

    @property
    def last(self) -> np.ndarray:
        """Last command."""
        return self._last

    def _ask(self, is_starting: bool, pose: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        known = {"pose": pose, "wrench": wrench}
        signals = [np.resize(known.get(name, 0.0), size) for name, size in self._signals.items()]
        self._socket.sendall(np.concatenate([[float(is_starting)], pose, *signals]).tobytes())
        received = b""
        while len(received) < pose.nbytes:
            if not (part := self._socket.recv(pose.nbytes - len(received))):
                raise RuntimeError("the program ended")
            received += part
        return np.frombuffer(received)

    def close(self) -> None:
        """End the program."""
        self._socket.close()
        self._process.wait()


def main() -> int:
    """Compare the episodes that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=100, help="number of episodes")
    parser.add_argument("--first", type=int, default=0, help="number of the first episode")
    parser.add_argument("--double", type=int, default=10, help="number of episodes also in double precision")
    arguments = parser.parse_args()
    folder = RunFolder(find_run(arguments.run))
    config, policy = folder.config(), Policy.load(folder.path)
    program, num_actions = Program(arguments.folder), len(policy.description["action_low"])

    @register_guidance("program", needs=(("demonstrations",),), label="C++ program", demonstrates=True, displaces=True)
    class ProgramLaw(Law):
        """Law whose state is the number of the control step, because a command is evaluated several times."""

        def __init__(self, num_outputs, known=None):
            super().__init__(num_outputs, num_actions, known)

        def default_state(self):
            return np.zeros(1)

        def start(self, pose):
            program.start(pose)
            return self.default_state()

        def command(self, state, action, pose, wrench):
            # At a reset, before the first step, the action is zero.
            return program.command(int(state[0]), pose, wrench) if np.any(action) else program.last

        def next(self, state, command, pose):
            return state + 1.0

    guided = make_environment(config.task, config.environment)
    runs = {
        "python": (guided, policy),
        "double": (guided, lambda observation: double_action(policy, observation)),
        "cpp": (
            make_environment(config.task, {**config.environment, "guidance": "program"}),
            lambda _: np.ones(num_actions, np.float32),
        ),
    }
    equal, success = 0, dict.fromkeys(("python", "cpp"), 0)
    differences: dict[str, list[float]] = {"python": [], "double": []}
    for number in range(arguments.episodes):
        episode = arguments.first + number
        rows = {
            name: rollout(env, act, Paths(env), seed=HELD_OUT_SEED + episode, held_out=True)
            for name, (env, act) in runs.items()
            if name != "double" or number < arguments.double
        }
        outcome = {name: [row.get(key) for key in OUTCOME] for name, row in rows.items()}
        is_equal = all(each == outcome["cpp"] for each in outcome.values())
        equal += is_equal
        for name in success:
            success[name] += bool(rows[name]["success"])
        verdict = f"equal, {outcome['cpp']}" if is_equal else f"DIFFERENT: {outcome}"
        for name in rows.keys() - {"cpp"}:
            differences[name].append(_difference(rows[name], rows["cpp"]))
            verdict += f", commands differ by {differences[name][-1]:.2g} m or rad from {name}"
        print(f"episode {episode}: {verdict}", flush=True)
    program.close()
    print(
        f"{equal} of {arguments.episodes} episodes have the same success, termination and number of steps; successes: "
        f"{success['python']} in Python, {success['cpp']} in C++"
    )
    for name, values in differences.items():
        if values:
            print(f"largest difference of a command from {name}: {max(values):.2g}, median {np.median(values):.2g}")
    return 0 if equal == arguments.episodes else 1


def _difference(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    """Return the largest difference of two episodes' commands, in the steps that both have."""
    steps = min(len(first["commanded"]), len(second["commanded"]))
    return float(np.abs(first["commanded"][:steps] - second["commanded"][:steps]).max())


if __name__ == "__main__":
    sys.exit(main())
