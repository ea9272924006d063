"""LeRobot robot that runs a simulated environment of guiderail in a child process."""

from __future__ import annotations

import json
import logging
import math
import subprocess
import sys
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from lerobot.robots import Robot, RobotConfig

logger = logging.getLogger(__name__)

SUFFIX = ".pos"  # ending of all names, because LeRobot's rollout passes only such numbers to a policy
POSE_NAMES = ("x", "y", "z", "rz", "ry", "rx")
WRENCH_NAMES = ("fx", "fy", "fz", "tx", "ty", "tz")
STOP_TIME = 10.0  # longest wait for the end of guiderail's process before it is killed [s]


@RobotConfig.register_subclass("guiderail")
@dataclass(kw_only=True)
class GuiderailRobotConfig(RobotConfig):
    """Configuration of the robot.

    Attributes:
        environment: Name of a task, or folder of a run, whose environment is used.
        options: Environment options by name; a JSON object on the command line.
        python: Python interpreter with guiderail; by default the interpreter of this process.
        seed: Seed of the first episode.
    """

    environment: str = "BncConnector"
    options: dict[str, Any] = field(default_factory=dict)
    python: str = sys.executable
    seed: int = 0


class GuiderailRobot(Robot):
    """Environment of guiderail as a robot; one action is one step of the environment.

    Actions pass guiderail's guidance, so its constraints and its force bound apply to every policy and teleoperator.
    After the end of an episode, the next action is not executed and starts a new episode.
    """

    config_class = GuiderailRobotConfig
    name = "guiderail"

    def __init__(self, config: GuiderailRobotConfig):
        super().__init__(config)
        self.config = config
        self._process: subprocess.Popen[str] | None = None
        self._state: dict[str, Any] = {}

    @cached_property
    def _description(self) -> dict[str, Any]:
        """First line that guiderail's process prints. If no process runs, a process is started to read the line."""
        if self._process is not None:
            return self._receive()
        self._start()
        try:
            return self._receive()
        finally:
            self._stop()

    @property
    def observation_features(self) -> dict[str, type]:
        """Names of the numbers of `get_observation`."""
        return dict.fromkeys(self._flatten(self._description), float)

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the numbers of an action, from -1 to 1."""
        return {f"action_{i}{SUFFIX}": float for i in range(self._description["action_size"])}

    @property
    def is_connected(self) -> bool:
        """True while guiderail's process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def is_calibrated(self) -> bool:
        """True: a simulated robot needs no calibration."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Start guiderail's process and the first episode.

        Raises:
            ConnectionError: If the robot is connected, or guiderail does not start, with guiderail's error message.
        """
        del calibrate
        if self.is_connected:
            raise ConnectionError(f"{self} is already connected")
        self._start()
        description = self._receive()
        self.__dict__["_description"] = description
        logger.info("%s: %g actions a second", self.config.environment, 1.0 / description["period"])
        self._state = self._ask({"reset": self.config.seed})

    def get_observation(self) -> dict[str, float]:
        """Return the state of the environment after the last action.

        Raises:
            ConnectionError: If the robot is not connected.
        """
        self._check_connected()
        return self._flatten(self._state)

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Advance the environment by one step, or, after the end of an episode, start a new episode.

        Args:
            action: Numbers of `action_features`.

        Returns:
            The action that was executed, clipped.

        Raises:
            ConnectionError: If the robot is not connected.
            ValueError: If a name is missing or unknown, or a number is NaN or infinite. The robot is not moved.
        """
        self._check_connected()
        names = list(self.action_features)
        if set(action) != set(names):
            raise ValueError(f"an action has the numbers {names}, not {list(action)}")
        values = [float(action[name]) for name in names]
        if not all(map(math.isfinite, values)):
            raise ValueError(f"an action must be finite, not {values}: the robot was not moved")
        values = [min(max(value, -1.0), 1.0) for value in values]
        self._state = self._ask({"reset": None} if self._state["is_done"] else {"action": values})
        return dict(zip(names, values, strict=True))

    def disconnect(self) -> None:
        """End guiderail's process.

        Raises:
            ConnectionError: If the robot is not connected.
        """
        self._check_connected()
        self._stop()

    def _check_connected(self) -> None:
        if not self.is_connected:
            raise ConnectionError(f"{self} is not connected: call connect() first")

    def _start(self) -> None:
        self._stop()  # closes the pipes of a process that has ended
        config = self.config
        command = [config.python, "-m", "guiderail_lerobot.env_server", config.environment, json.dumps(config.options)]
        try:
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        except OSError as error:
            raise ConnectionError(f"{config.python} does not start: {error.strerror}") from None

    def _stop(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            try:
                process.communicate(timeout=STOP_TIME)  # closes the input of the process, which then ends
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._process is not None
        assert self._process.stdin is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return self._receive()

    def _receive(self) -> dict[str, Any]:
        assert self._process is not None
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._stop()
            raise ConnectionError(f"the process of guiderail in {self.config.python} has ended")
        answer = json.loads(line)
        if "error" in answer:
            self._stop()
            raise ConnectionError(answer["error"])
        return answer

    @staticmethod
    def _flatten(state: dict[str, Any]) -> dict[str, float]:
        numbers = {f"observation_{i}": value for i, value in enumerate(state["observation"])}
        for signal, names in (("pose", POSE_NAMES), ("wrench", WRENCH_NAMES)):
            values = state[signal]
            used = names if len(values) == len(names) else range(len(values))
            numbers |= {f"{signal}_{name}": value for name, value in zip(used, values, strict=True)}
        numbers |= {"episode_done": float(state["is_done"]), "episode_success": float(state["is_success"])}
        return {name + SUFFIX: float(value) for name, value in numbers.items()}
