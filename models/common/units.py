"""Units outside SI, in SI units."""

import math

MM = 1e-3  # [m]
DEGREE = math.radians(1.0)  # [rad]
