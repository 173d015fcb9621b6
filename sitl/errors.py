"""The exception of `mimopilot.sitl`."""

from mimopilot.common.errors import Error


class SitlError(Error, RuntimeError):
    """The simulation, a vehicle or a link cannot do what was requested."""
