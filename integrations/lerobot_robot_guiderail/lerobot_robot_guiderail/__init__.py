"""guiderail in LeRobot: simulated robots under guidance, and trained policies."""

from lerobot_robot_guiderail.configuration_guiderail import GuiderailConfig
from lerobot_robot_guiderail.robot import GuiderailRobot, GuiderailRobotConfig

__all__ = ["GuiderailConfig", "GuiderailRobot", "GuiderailRobotConfig"]
