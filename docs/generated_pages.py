"""Pages of the manual that are generated when the site is built: all commands, and the public API.

A hook of mkdocs (`mkdocs.yml`); the commands' own help and the docstrings are the source, so nothing is written twice.
"""

from __future__ import annotations

import os
import re
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

# The help of a command is as wide as the terminal: here as wide as a page.
os.environ["COLUMNS"] = "100"

import typer.main

from mimopilot import _PUBLIC
from mimopilot.cli.main import app


def _cell(text: object) -> str:
    """Text for a cell of a table."""
    return re.sub(r"\s+", " ", str(text or "")).replace("|", "\\|").replace("<", "&lt;")


def _parameter_row(parameter: Any) -> str:
    """One option or argument: its names, help and default."""
    hidden = callable(parameter.default) or parameter.default in (None, False, (), [])
    value = getattr(parameter.default, "value", parameter.default)
    default = "" if hidden or parameter.required else f"`{_cell(value)}`"
    names = parameter.opts if parameter.param_type_name == "option" else [parameter.name]
    needed = "required" if parameter.required else default
    return f"| {', '.join(f'`{name}`' for name in names)} | {_cell(parameter.help)} | {needed} |"


def commands_page() -> str:
    """Every command: description, options with their defaults, examples."""
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    parts = [
        "# Commands",
        "Generated from the commands themselves; `mimopilot COMMAND --help` prints the same. Global options: "
        "`--quiet`, `--verbose`, `--version`.",
    ]
    for name in sorted(commands):
        command = commands[name]
        parts += [f"## {name}", re.sub(r"\n(?!\n)", " ", command.help or "").replace("<", "&lt;")]
        if command.params:
            shown = (parameter for parameter in command.params if not getattr(parameter, "hidden", False))
            rows = map(_parameter_row, shown)
            parts.append("\n".join(["| option | what | default |", "|---|---|---|", *rows]))
        examples = (command.epilog or "").removeprefix("Example: ").split("; ")
        parts.append("\n".join(["```", *filter(None, examples), "```"]))
    return "\n\n".join(parts) + "\n"


def api_page() -> str:
    """Every public name, from its docstring."""
    parts = ["# API", "`import mimopilot as mp`: every public name, from its docstring. See [From Python](python.md)."]
    parts += [f"::: {module}.{name}" for name, module in _PUBLIC.items()]
    return "\n\n".join(parts) + "\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    for uri, text in (("commands.md", commands_page()), ("api.md", api_page())):
        files.append(File.generated(config, uri, content=text))
    return files
