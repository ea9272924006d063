"""guiderail in LeRobot: simulated robots under guidance, and trained policies."""

from lerobot_robot_guiderail.configuration_guiderail import GuiderailConfig
from lerobot_robot_guiderail.robot import Guiderail, GuiderailRobotConfig

__all__ = ["Guiderail", "GuiderailConfig", "GuiderailRobotConfig"]
