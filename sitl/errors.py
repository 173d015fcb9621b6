"""The exception of the simulation."""

from mimopilot.common.errors import Error


class SitlError(Error, RuntimeError):
    """The simulation, a vehicle or a link cannot do what was asked."""
