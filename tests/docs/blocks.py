"""The code blocks of README and manual, and how each is to be checked.

An HTML comment on the line above a block says what the language does not:

    <!-- vehicle -->            it needs a vehicle, a ground station or an autopilot: its commands are only parsed
    <!-- test: FILE::NAME -->   that test runs it: it takes long, or needs more than a folder
    <!-- run: A => B; C => D -->  run with B in place of A: fewer runs
    <!-- toml: KIND -->         a file of that kind, read by its reader; commands find it as KIND.toml

Languages: none or `sh` for commands, `console` for commands (after `$`) with lines of their output, `toml`, `python`,
and `text` for what is neither: equations, trees, columns.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tests.paths import DOCS, TOP

LANGUAGES = ("", "sh", "console", "toml", "python", "text")
BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>[^\n]*?) -->\n)?^ *```(?P<language>\w*)\n(?P<text>.*?)^ *```$", re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True)
class Block:
    """A fenced block: where it is, its language, the comment above it, its text."""

    page: Path
    line: int
    language: str
    mark: str
    text: str

    @property
    def name(self) -> str:
        """PAGE:LINE, for messages and test names."""
        return f"{self.page.relative_to(TOP)}:{self.line}"

    def value(self, kind: str) -> str | None:
        """What the comment says after `kind:`; None if it is of another kind."""
        key, _, value = self.mark.partition(":")
        return value.strip() if key.strip() == kind else None

    @property
    def commands(self) -> list[tuple[str, list[str]]]:
        """Each command line without its comment, with the lines of output shown below it."""
        found: list[tuple[str, list[str]]] = []
        for row in self.text.splitlines():
            if self.language == "console" and not row.startswith("$ "):
                if row.strip():
                    found[-1][1].append(row)
            elif row.strip():
                found.append((re.sub(r"\s+#.*$", "", row.removeprefix("$ ")).strip(), []))
        return found


def blocks_of(page: Path) -> list[Block]:
    """All blocks of a page, in their order."""
    text = page.read_text()
    return [
        Block(page, text.count("\n", 0, m.start()) + 1, m["language"], m["mark"] or "", m["text"])
        for m in BLOCK.finditer(text)
    ]


PAGES = [TOP / "README.md", *sorted(DOCS.rglob("*.md"))]
BLOCKS = [block for page in PAGES for block in blocks_of(page)]
