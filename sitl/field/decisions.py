"""What was done and decided, in DIR/decisions.json: a workflow that was interrupted goes on from it.

No clock is in it: a step is done or not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mimopilot.common.console import json_text
from mimopilot.common.files import inside, read_text, write_atomically
from mimopilot.sitl.errors import SitlError

NAME = "decisions.json"
VERSION = 1


@dataclass
class Decisions:
    """Steps done, in order, and the end.

    Attributes
    ----------
    folder : Path
    profile : str
    steps : dict
        Name of a step that is done -> what it found.
    begun : bool
        New values may have been written to the vehicle, and nothing says yet that they are kept or taken back.
    result : str
        How it ended: ``kept`` or ``old``; empty: it has not.
    reason : str
        Why; without a result: why the old gains must go back.
    """

    folder: Path
    profile: str
    steps: dict[str, dict[str, Any]] = field(default_factory=dict)
    begun: bool = False
    result: str = ""
    reason: str = ""

    @property
    def path(self) -> Path:
        """The file."""
        return inside(self.folder, NAME)

    def save(self) -> None:
        """Write the file.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        write_atomically(self.path, json_text(self.as_table()))

    def as_table(self) -> dict[str, Any]:
        """The content of the file."""
        return {
            "version": VERSION,
            "profile": self.profile,
            "steps": self.steps,
            "new_values_may_be_on_the_vehicle": self.begun,
            "result": self.result,
            "reason": self.reason,
        }

    def add(self, step: str, found: Mapping[str, Any]) -> None:
        """Record a step that is done."""
        self.steps[step] = dict(found)
        self.save()

    def forget_from(self, step: str) -> None:
        """Forget a step and those after it: they are done again."""
        names = list(self.steps)
        for name in names[names.index(step) :] if step in names else []:
            del self.steps[name]
        self.save()

    def note(self, reason: str) -> None:
        """Record why the old gains go back, before they do; a disk that is full does not stop that."""
        self.reason = reason
        with suppress(OSError):
            self.save()

    def end(self, result: str, reason: str) -> None:
        """Record the end."""
        self.begun, self.result, self.reason = False, result, reason
        self.save()


def load_decisions(folder: Path, profile: str) -> Decisions:
    """Decisions of a folder, or none yet.

    Raises
    ------
    SitlError
        If the file is damaged, or of another profile.
    """
    path = inside(folder, NAME)
    if not path.exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise SitlError(f"{folder}: holds files, but no {NAME}: give a new folder, or that of an earlier autotune")
        return Decisions(folder, profile)
    another = "give another --out to begin anew"
    try:
        found = json.loads(read_text(path, "record of decisions"))
        steps, begun = found["steps"], found["new_values_may_be_on_the_vehicle"]
        if found["version"] != VERSION or not isinstance(steps, dict) or not isinstance(begun, bool):
            raise ValueError(f"version {found['version']}, expected {VERSION}")
        known = Decisions(folder, str(found["profile"]), steps, begun, str(found["result"]), str(found["reason"]))
    except (ValueError, KeyError, TypeError) as error:
        raise SitlError(f"{path}: cannot be read: {error}; {another}") from error
    if known.profile != profile:
        raise SitlError(f"{path}: is for --profile {known.profile}, not {profile}; {another}")
    return known
