"""The targets: every folder of ``firmware_templates/`` with a ``target.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from mimopilot.codegen.errors import CodegenError
from mimopilot.common.errors import check_choice

if TYPE_CHECKING:  # the command line reads the table for its help and must start fast
    from mimopilot.tuning.gains import Gains

TEMPLATES = Path(__file__).resolve().parent.parent / "firmware_templates"
DESCRIPTION = "target.toml"
#: Largest relative difference of the vehicle's control rate from that of the gains with which emitted code takes over.
RATE_TOLERANCE = 0.05


@dataclass(frozen=True)
class Target:
    """One target.

    Attributes
    ----------
    name : str
        Name on the command line.
    help : str
        Short help for the command line.
    folders : tuple of str
        Folders of ``firmware_templates`` to render; ``package`` goes to the root of the output.
    folder : str
        The target's own folder.
    contents, usage : str
        Its texts in the README of the tree; may be empty.
    options : mapping
        Option -> values, the default first.
    rates : tuple of float
        Control rates that the vehicle can run, Hz; empty: any.
    rate_source : str
        What sets the rate on the vehicle.
    shaped_setpoints : bool
        Whether the autopilot shapes the attitude setpoints and gives their rate (ArduPilot's input shaping).
    """

    name: str
    help: str
    folders: tuple[str, ...]
    folder: str
    contents: str = ""
    usage: str = ""
    options: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    rates: tuple[float, ...] = ()
    rate_source: str = ""
    shaped_setpoints: bool = False

    def rate(self, gains: Gains) -> float:
        """The vehicle's control rate that is nearest to that of the gains, Hz."""
        return min(self.rates, key=lambda hertz: abs(1 / gains.Ts / hertz - 1), default=1 / gains.Ts)

    def rate_warning(self, gains: Gains) -> str:
        """What to do about gains for a rate that the vehicle does not run; empty if it does."""
        rate, nearest = 1 / gains.Ts, self.rate(gains)
        if abs(rate / nearest - 1) <= RATE_TOLERANCE:
            return ""
        return (
            f"Ts: the gains are for {rate:.4g} Hz, but {self.name} runs the controller at {self.rate_source}, "
            f"{', '.join(f'{hertz:g}' for hertz in self.rates)} Hz, where the emitted code refuses to "
            f"start; carry the gains to that rate: mimopilot certify LOG --gains FILE --rate {nearest:g} --out NEW"
        )

    def shaping_warning(self, gains: Gains) -> str:
        """What to do about gains designed for shaped setpoints that the vehicle does not shape; empty if it does."""
        if not gains.filters.shaping_s or self.shaped_setpoints or not self.rates:
            return ""
        return (
            f"shaping_s: the gains are designed for setpoints as ArduPilot shapes them, with their rate fed forward; "
            f"{self.name} does neither, so the vehicle follows less well than predicted; stability is the same; for "
            f"gains of its own tune from a log of {self.name}"
        )

    def chosen(self, options: Mapping[str, str]) -> dict[str, str]:
        """Value of every option; the default if it is not given.

        Raises
        ------
        CodegenError
            If an option or its value is unknown. Options of other targets are ignored.
        """
        for name, value in options.items():
            owners = [target for target in targets().values() if name in target.options]
            if not owners:
                known = sorted({name for target in targets().values() for name in target.options})
                raise CodegenError(f"option {name!r}: no target has it; known: {', '.join(known)}")
            values = (self if self in owners else owners[0]).options[name]
            check_choice(name.replace("_", "-"), value, values, CodegenError)
        return {name: options.get(name, values[0]) for name, values in self.options.items()}


@lru_cache(maxsize=1)
def targets() -> dict[str, Target]:
    """All targets, by name."""
    found: dict[str, Target] = {}
    for path in sorted(TEMPLATES.glob(f"*/{DESCRIPTION}")):
        try:
            table = tomllib.loads(path.read_text())
            folders, options = tuple(table.pop("folders")), table.pop("options", {})
            rates = tuple(table.pop("rates", ()))
            choices = {name: tuple(values) for name, values in options.items()}
            target = Target(**table, folders=folders, folder=path.parent.name, options=choices, rates=rates)
        except (KeyError, TypeError, tomllib.TOMLDecodeError) as error:
            raise CodegenError(f"{path}: not a target: {error}; expected the entries of `Target`") from error
        if target.name in found:
            other = found[target.name].folder
            raise CodegenError(f"{path}: {target.name} is the target of {other}; choose another name")
        found[target.name] = target
    return found


def find_target(name: str) -> Target:
    """The target of this name.

    Raises
    ------
    CodegenError
        If there is none; lists the known ones.
    """
    check_choice("target", name, sorted(targets()), CodegenError)
    return targets()[name]
