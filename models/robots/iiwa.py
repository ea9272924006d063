"""Where the iiwa's files lie, and what a controller needs to know of it beyond them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent
IIWA_URDF = FOLDER / "iiwa14.urdf"
CONNECTOR_TOOL_URDF = FOLDER / "connector_tool.urdf"

NUM_JOINTS = 7
# Elbow up, tool down, far from every limit and singularity; where an inverse kinematics starts and a posture returns.
READY_POSTURE = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0])  # [rad]
