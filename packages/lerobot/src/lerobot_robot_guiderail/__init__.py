"""guiderail in LeRobot: simulated robots under guidance, trained policies, and the guard of chunks."""

from lerobot_robot_guiderail.configuration_guiderail import GuiderailConfig
from lerobot_robot_guiderail.guard import ChunkGuardProcessorStep, add_guard
from lerobot_robot_guiderail.robot import GuiderailRobot, GuiderailRobotConfig

__all__ = ["ChunkGuardProcessorStep", "GuiderailConfig", "GuiderailRobot", "GuiderailRobotConfig", "add_guard"]
