"""Compare a policy in Python with its exported C++ program on held-out episodes, both against the simulator.

    guiderail export pretrained:connector --target cpp --out connector
    cmake -S connector -B connector/build && cmake --build connector/build
    python packages/cpp/scripts/lockstep.py pretrained:connector connector --episodes 100

The program computes observation, action and command of each control step from the measured pose and wrench, over a
socket, while the simulator waits. The exit status is 0 if every episode has the same outcome.
"""

import argparse
import json
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np

from guiderail import register_guidance
from guiderail.models.laws import Law
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.rollout import Paths, rollout
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run

OUTCOME = ("success", "termination", "steps")


class Program:
    """Connection to the program `lockstep`."""

    def __init__(self, folder: Path):
        self._signals = json.loads((folder / "skill.json").read_text())["signals"]
        command = [folder / "build/lockstep", folder / "skill.safetensors"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._socket = socket.create_connection(("127.0.0.1", int(self._process.stdout.readline())))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.is_starting = True

    def __call__(self, action: np.ndarray, pose: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        """Return the command for a measured pose and wrench; the action of the environment is not used."""
        known = {"pose": pose, "wrench": wrench}
        signals = [known.get(name, np.zeros(size))[:size] for name, size in self._signals.items()]
        self._socket.sendall(np.concatenate([[float(self.is_starting)], pose, *signals]).tobytes())
        self.is_starting = False
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
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    folder = RunFolder(find_run(arguments.run))
    config, policy = folder.config(), Policy.load(folder.path)
    program = Program(arguments.folder)

    @register_guidance("program", needs=(("demonstrations",),), label="C++ program", demonstrates=True, displaces=True)
    class ProgramLaw(Law):
        def __init__(self, num_outputs, num_actions=None, known=None):
            super().__init__(num_outputs, len(policy.description["action_low"]), known)

        def command(self, state, action, pose, wrench):
            return program(action, pose, wrench)

    names = ("python", "cpp")
    environments = {
        "python": make_environment(config.task, config.environment),
        "cpp": make_environment(config.task, {**config.environment, "guidance": "program"}),
    }
    equal, worst = 0, 0.0
    success = dict.fromkeys(names, 0)
    for episode in range(arguments.episodes):
        rows = {}
        for name, env in environments.items():
            program.is_starting = True
            act = (
                policy if name == "python" else (lambda _: np.zeros(len(policy.description["action_low"]), np.float32))
            )
            paths = Paths(env)
            rows[name] = rollout(env, act, paths, seed=HELD_OUT_SEED + episode, held_out=True)
            success[name] += bool(rows[name]["success"])
        outcome = [[rows[name].get(key) for key in OUTCOME] for name in names]
        equal += outcome[0] == outcome[1]
        commands = [rows[name]["commanded"] for name in names]
        if len(commands[0]) == len(commands[1]):
            worst = max(worst, float(np.abs(commands[0] - commands[1]).max()))
        if outcome[0] != outcome[1]:
            print(f"episode {episode}: {outcome[0]} in Python, {outcome[1]} in C++")
    program.close()
    print(
        f"{equal} of {arguments.episodes} episodes have the same success, termination and number of steps; successes: "
        f"{success['python']} in Python, {success['cpp']} in C++; largest difference of a command {worst:.2g} m or rad"
    )
    return 0 if equal == arguments.episodes else 1


if __name__ == "__main__":
    sys.exit(main())
