"""MAVLink's messages and constants for other packages: without pymavlink its extra is named, see `sitl.mavlink`."""

from pymavlink.dialects.v20 import common as mavlink

__all__ = ["mavlink"]
