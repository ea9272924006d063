"""Loop of an exported skill: `python loop.py` replays `recording.npz` and prints the largest difference in commands.

It needs NumPy, ONNX Runtime and guiderail without extras, but neither Drake nor PyTorch. To run the skill, call
`Skill.start` with the measured pose, and then `Skill.step` once every `period` seconds with measured pose and wrench:
it returns the pose to command. Poses are [x y z Rz Ry Rx] in meters and radians in the frame of the task's target; a
wrench is the force and the torque of the surroundings on the tool, about the tool center [N, Nm]. A force-torque sensor
is tared before the episode. Every command satisfies `skill.law.primitive.constraints`, G y >= c.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, require_extra
from guiderail.models.control.wrench import ContactPointMean, center_of_pressure
from guiderail.models.laws import Stepper, load_law


class Skill:
    """Exported skill.

    Attributes:
        period: Control period [s].
        num_steps: Control steps of an episode.
        entries: Entries of the observation, as in `skill.json`.
        law: Law that turns actions into poses within the constraints.
    """

    def __init__(self, folder: Path | str = Path(__file__).parent) -> None:
        self._about = json.loads((Path(folder) / "skill.json").read_text())
        self.entries = self._about["observation"]
        require_extra("onnxruntime")
        import onnxruntime

        self._policy = onnxruntime.InferenceSession(Path(folder) / self._about["policy"])
        self.law, self.period = load_law(folder), self._about["control_period_s"]
        self.num_steps = self.law.primitive.num_steps

    def start(self, pose: Any) -> None:
        """Begin an episode at the measured pose."""
        contact = self._about["contact"]
        self._contact = ContactPointMean(contact["min_force"], contact["memory_s"] / self.period)
        self._stepper = Stepper(self.law, pose)
        # Before the first command, the policy observes the command of an action of zero.
        self._command = Stepper(self.law, pose).step(np.zeros(self.law.num_actions)).pose

    def step(self, pose: Any, wrench: Any, **others: Any) -> np.ndarray:
        """Return the pose to command in this control step; `others` are further signals of `skill.json`, if any."""
        pose, wrench, step = np.asarray(pose, float), np.asarray(wrench, float), self._stepper.num_steps
        if not (np.isfinite(pose).all() and np.isfinite(wrench).all()):
            raise ValueError("pose and wrench must be finite: stop the robot, or hold the last command")
        if step % self._about["action_repeat"] == 0:
            signals: dict[str, Any] = {"pose": pose, "wrench": wrench, "desired_pose": self._command, **others}
            signals |= {"time": [step * self.period], "phase": [2.0 * step / self.num_steps - 1.0]}
            if len(wrench) == 6:
                signals["center_of_pressure"] = center_of_pressure(wrench, self._contact.min_force)
                signals["mean_contact_point"] = self._contact.relative_to(pose)
            values = [(signals[e["signal"]][e["index"]] - e["center"]) / e["scale"] for e in self.entries]
            clip = self.entries[0]["clip"]
            observation = np.clip(values, -clip, clip).astype(np.float32)
            (self.action,) = self._policy.run(None, {"observation": observation[None]})[0]
        if len(wrench) == 6:
            self._contact.add(pose, wrench)
        self._command = self._stepper.step(self.action).pose
        return self._command


def replay(folder: Path | str = Path(__file__).parent) -> float:
    """Return the largest difference between the commands of the loop and those of `recording.npz`."""
    skill, recording, largest = Skill(folder), np.load(Path(folder) / "recording.npz"), 0.0
    signals = [name for name in recording.files if name not in ("reset", "pose", "command")]
    for step, pose in enumerate(recording["pose"]):
        if recording["reset"][step]:
            skill.start(pose)
        others = {name: recording[name][step] for name in signals}
        command = skill.step(pose, others.pop("wrench", ()), **others)
        largest = max(largest, float(np.abs(command - recording["command"][step]).max()))
    return largest


if __name__ == "__main__":
    try:
        print(f"largest difference from the recorded commands: {replay():.1e} m or rad")
    except InputError as error:
        print(f"loop.py: {error}", file=sys.stderr)
        sys.exit(2)
