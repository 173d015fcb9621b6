"""What can be generated: every folder of ``firmware_templates/`` with a ``target.toml`` is a target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from mimopilot.codegen.errors import CodegenError

from mimopilot.common.toml import read_toml

TEMPLATES = Path(__file__).resolve().parent.parent / "firmware_templates"
DESCRIPTION = "target.toml"


@dataclass(frozen=True)
class Target:
    """One target.

    Attributes
    ----------
    name : str
        As the command line calls it.
    help : str
        A few words for the command line.
    folders : tuple of str
        Folders of ``firmware_templates`` that the tree is made of; ``package`` is the root of the output.
    folder : str
        The one that is its own.
    contents, usage : str
        What stands of it in the README of the tree; empty: nothing.
    options : mapping
        Option -> its values, the default first.
    """

    name: str
    help: str
    folders: tuple[str, ...]
    folder: str
    contents: str = ""
    usage: str = ""
    options: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def chosen(self, options: Mapping[str, str]) -> dict[str, str]:
        """Value of every option; those that are not given have their default.

        Raises
        ------
        CodegenError
            When a value is unknown. Options of other targets are ignored.
        """
        for name, value in options.items():
            values = self.options.get(name, (value,))
            if value not in values:
                raise CodegenError(f"{name.replace('_', '-')}: got {value!r}, expected one of {', '.join(values)}")
        return {name: options.get(name, values[0]) for name, values in self.options.items()}


@lru_cache(maxsize=1)
def targets() -> dict[str, Target]:
    """Every target by its name."""
    found = {}
    for path in sorted(TEMPLATES.glob(f"*/{DESCRIPTION}")):
        table = read_toml(path, "target")
        folders, options = tuple(table.pop("folders")), table.pop("options", {})
        choices = {name: tuple(values) for name, values in options.items()}
        found[table["name"]] = Target(**table, folders=folders, folder=path.parent.name, options=choices)
    return found


def find_target(name: str) -> Target:
    """A target by its name.

    Raises
    ------
    CodegenError
        When there is none; lists those that there are.
    """
    if name not in targets():
        raise CodegenError(f"target: got {name!r}, expected one of {', '.join(sorted(targets()))}")
    return targets()[name]
