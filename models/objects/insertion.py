"""Numbers that the insertions share, whatever goes into what."""

from guiderail.models.common.units import DEGREE, MM

COLLISION_FORCE = 35.0  # [N], of the impedance: more ends an episode
MIN_CONTACT_FORCE = 0.5  # [N] with which a plug stands on something

# A torque grows with the push; divided by it, it is the lever, which doesn't. Where the command is tells what an
# action led to, which a pose that a rim holds back does not.
LEVER_SCALE, COMMAND_SCALE = 3.0 * MM, 2.0 * MM

# ρ [m², rad²]. The thesis's 1e-8 is (0.1 mm)², much for demonstrations that vary by a millimetre.
HISTORY_VARIANCE = 1e-11

# How well a hand repeats itself, [x y z Rz Ry Rx]: added to the demonstrations' covariance as a standard deviation.
REPEATABILITY_STD = (0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE)
