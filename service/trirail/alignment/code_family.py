"""Names of the families of coded marks, as in OpenCV. This module does not import numpy, to keep the CLI fast."""

from __future__ import annotations

from typing import Literal

CodeFamily = Literal[
    "4x4_50", "4x4_100", "5x5_100", "6x6_250", "apriltag_16h5", "apriltag_25h9", "apriltag_36h10", "apriltag_36h11"
]
