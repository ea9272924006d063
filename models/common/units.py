"""Units that are not SI's own, in SI's."""

import math

MM = 1e-3  # [m]
DEGREE = math.radians(1.0)  # [rad]
