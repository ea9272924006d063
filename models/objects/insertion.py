"""Constants that all insertion tasks share."""

from guiderail.models.common.transforms import DEGREE, MM

COLLISION_FORCE = 35.0  # contact force above which an episode ends [N]
MIN_CONTACT_FORCE = 0.5  # smallest force of a plug in contact [N]

# Scales of the observed center of pressure and of the observed command. The center of pressure, unlike the torque, does
# not grow with the push. The command shows the effect of an action; the measured pose of a plug on a rim does not.
CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE = 3.0 * MM, 2.0 * MM

# Variance ρ of the history [m², rad²]; the thesis's 1e-8, (0.1 mm)², is too large for demonstrations that vary by 1 mm.
HISTORY_VARIANCE = 1e-11

# Standard deviation of a hand's repeatability [x y z Rz Ry Rx], added to the demonstrations' covariance.
REPEATABILITY_STD = (0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE)
