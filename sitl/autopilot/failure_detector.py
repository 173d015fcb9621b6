"""Limits of the failure detector: a vehicle tilted beyond `MAX_TILT` for `MAX_TILT_SECONDS` counts as lost."""

from __future__ import annotations

import math

MAX_TILT = math.radians(60.0)  # rad, of roll and of pitch; PX4's defaults of FD_FAIL_R and FD_FAIL_P
MAX_TILT_SECONDS = 0.3  # s; PX4's defaults of FD_FAIL_R_TTRI and FD_FAIL_P_TTRI
