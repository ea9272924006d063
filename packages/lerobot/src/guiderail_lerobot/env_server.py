"""Server of a simulated environment for programs in another Python environment: one line of JSON per message.

Started by `python -m guiderail_lerobot.env_server TASK_OR_RUN [OPTIONS]`; OPTIONS is a JSON object of environment
options. It reads requests from standard input and answers on standard output, and ends when its input ends. Requests
are `{"reset": SEED}`, with null to continue the random stream, and `{"action": [...]}`; an action is clipped to
[-1, 1]. The first line and every answer have `observation`, `pose`, `wrench`, `is_done`, `is_success` and
`termination`. The first line also has `action_size` and `period`, the duration of an action [s]. A refused request is
answered with `error` alone, and the simulation does not advance.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import IO, Any

import gymnasium
import numpy as np

from guiderail.diagrams.envs.env import DiagramEnv
from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail.tools.files import path_exists
from guiderail.tools.learning.run_folder import RunFolder, as_arguments

MAX_LINE = 100_000  # longest request, including the end of its line [characters]


def open_environment(name: str, options: dict[str, Any]) -> DiagramEnv:
    """Return the environment of a run or of a task, with some options changed.

    Args:
        name: Folder of a run, or name of a task.
        options: Options of the environment by name; they override those of the run.

    Raises:
        InputError: If there is no such task, the file system refuses the name, the files of a run's task have changed,
            or an option is invalid.
    """
    if path_exists(config_file := Path(name) / "config.yaml") and config_file.is_file():
        config = RunFolder(name).config()
        config.refuse_changed_task(Path(name), "open the task by its name")
        name, options = config.task, config.environment | options
    if "task" in options:
        raise InputError("the task is the first argument: leave the option 'task' out")
    return make_env(name, **as_arguments(options))


class EnvServer:
    """Server that answers requests for one environment.

    Args:
        env: Environment to reset and step.
    """

    def __init__(self, env: DiagramEnv):
        self._env = env
        self._station = env.diagram.diagram.GetSubsystemByName("station")
        self._is_done, self._info = False, {"is_success": False, "termination": ""}
        # A reset with a seed begins a new run, so that the seed determines the values that are hidden for a whole run.
        self._seed_options: dict[str, Any] = {"new_run": True}
        try:
            self._observation = env.reset(seed=0, options=self._seed_options)[0]
        except InputError:  # the task has no values that are hidden for a whole run
            self._seed_options = {}
            self._observation = env.reset(seed=0)[0]

    def describe(self) -> dict[str, Any]:
        """Return the content of the first line, which describes the environment and its state."""
        action_space = self._env.action_space
        return {"action_size": action_space.shape[0], "period": self._env.time_step} | self._state()

    def answer(self, request: Any) -> dict[str, Any]:
        """Return the answer to a request, which is any value that JSON can represent."""
        try:
            if not isinstance(request, dict) or len(request) != 1 or next(iter(request)) not in ("reset", "action"):
                raise InputError('a request is {"reset": SEED} or {"action": [...]}')
            if "reset" in request:
                seed = request["reset"]
                if seed is not None and (type(seed) is not int or not 0 <= seed < 2**31):
                    raise InputError("a seed is a whole number from 0 to 2147483647, or null")
                options = {} if seed is None else self._seed_options
                self._observation, self._info = self._env.reset(seed=seed, options=options)
                self._is_done = False
            else:
                self._observation, _, terminated, truncated, self._info = self._env.step(request["action"])
                self._is_done = terminated or truncated
        except (InputError, gymnasium.error.ResetNeeded) as error:
            return {"error": str(error)}
        return self._state()

    def _state(self) -> dict[str, Any]:
        context = self._station.GetMyContextFromRoot(self._env.simulator.get_context())
        return {
            "observation": np.asarray(self._observation, float).tolist(),
            **{name: self._station.GetOutputPort(name).Eval(context).tolist() for name in ("pose", "wrench")},
            "is_done": self._is_done,
            "is_success": bool(self._info["is_success"]),
            "termination": str(self._info["termination"]),
        }


def serve(server: EnvServer, requests: IO[str], answers: IO[str]) -> None:
    """Answer requests until the input ends."""
    print(json.dumps(server.describe()), file=answers, flush=True)
    while line := requests.readline(MAX_LINE):
        try:
            _check_complete(line, requests)
            answer = server.answer(json.loads(line))
        except (ValueError, RecursionError):
            answer = {"error": f"a request is one line of JSON, of at most {MAX_LINE} characters"}
        print(json.dumps(answer), file=answers, flush=True)


def _check_complete(line: str, requests: IO[str]) -> None:
    """Raise a ValueError if a line is too long; first read the rest of it, so that it is answered only once."""
    if len(line) < MAX_LINE or line.endswith("\n"):
        return
    while len(line) == MAX_LINE and not line.endswith("\n"):
        line = requests.readline(MAX_LINE)
    raise ValueError


def main(arguments: list[str]) -> int:
    """Serve the environment that the arguments name; return the exit code."""
    # Redirect standard output to standard error: messages of libraries would be read as answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    try:
        if not 1 <= len(arguments) <= 2:
            raise InputError("name a task or the folder of a run, and options as a JSON object")
        try:
            options = json.loads(arguments[1]) if len(arguments) == 2 else {}
        except ValueError:
            options = None
        if not isinstance(options, dict):
            raise InputError("options are a JSON object of names and values")
        server = EnvServer(open_environment(arguments[0], options))
    except InputError as error:
        print(json.dumps({"error": str(error)}), file=answers, flush=True)
        return 2
    serve(server, sys.stdin, answers)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
