"""Packages that only some commands need: each with the extra of mimopilot that installs it, and what it is for."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

from mimopilot.common.errors import Error


@dataclass(frozen=True)
class Extra:
    """An optional package.

    Attributes
    ----------
    package : str
        As it is imported and installed.
    name : str
        The extra that installs it.
    use : str
        What needs it.
    """

    package: str
    name: str
    use: str

    @property
    def advice(self) -> str:
        """The command that installs it."""
        return f"pip install 'mimopilot[{self.name}]'"

    def need(self) -> None:
        """Refuse to begin without the package.

        Raises
        ------
        Error
            With the command that installs it.
        """
        try:
            import_module(self.package)
        except ImportError:
            raise Error(f"{self.use} needs {self.package}, which is not installed: {self.advice}") from None


VEHICLE = Extra("pymavlink", "vehicle", "a MAVLink link to a vehicle, real or simulated,")
REPORT = Extra("plotly", "report", "a page with interactive figures")
CAMPAIGN = Extra("pyarrow", "campaign", "a campaign, which keeps its flights as Parquet,")
CLUSTER = Extra("distributed", "cluster", "--scheduler")
EMULATOR = Extra("unicorn", "emulator", "the emulated Cortex-M4")
EXTRAS = (VEHICLE, REPORT, CAMPAIGN, CLUSTER, EMULATOR)
