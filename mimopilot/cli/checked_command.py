"""What every command checks before it runs: that its results can be written, and replace nothing that it reads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand

from mimopilot.common.errors import Error

#: Parameters that name results. Every other path is read.
RESULTS = ("out", "report", "figures", "snapshot")
#: Commands that may write gains back to the file that they came from: with a certificate, or in another unit.
WRITE_BACK = ("certify", "convert")


class CheckedCommand(TyperCommand):
    """A command that refuses, before it works for a minute, results that could not be kept."""

    def invoke(self, ctx: Any) -> Any:
        """Check the results' paths, then run."""
        options = {parameter.name: max(parameter.opts, key=len) for parameter in self.params}
        results = {name: path for name in RESULTS if isinstance(path := ctx.params.get(name), Path)}
        read = [value for name, value in ctx.params.items() if name not in (*RESULTS, *self._written_back(ctx))]
        for name, path in results.items():
            _check_place(options[name], path)
            if any(path.samefile(source) for source in _files(read) if path.exists()):
                raise Error(f"{options[name]}: {path} is read by this command; give another path")
            if any(path.absolute() == other.absolute() for one, other in results.items() if one != name):
                raise Error(f"{options[name]}: {path} is given for two results; give each its own path")
        return super().invoke(ctx)

    def _written_back(self, ctx: Any) -> tuple[str, ...]:
        """Parameters whose files may be replaced."""
        return ("gains",) if ctx.info_name in WRITE_BACK else ()


def use_command(app: typer.Typer) -> None:
    """Make every command of an application a `CheckedCommand`."""
    for info in app.registered_commands:
        info.cls = CheckedCommand


def _files(values: Iterable[Any]) -> Iterator[Path]:
    """The files among the values of parameters; folders are written into, not replaced."""
    for value in values:
        for one in value if isinstance(value, list | tuple) else (value,):
            if isinstance(one, Path) and one.is_file():
                yield one


def _check_place(option: str, path: Path) -> None:
    """Refuse a path below something that is no folder, and standard output."""
    if str(path) == "-":
        raise Error(f"{option}: nothing is written to standard output; give a path")
    nearest = next(parent for parent in path.absolute().parents if parent.exists())
    if not nearest.is_dir():
        shown = next((parent for parent in path.parents if parent.absolute() == nearest), nearest)
        raise Error(f"{option}: {path}: {shown} is not a folder; give another path")
