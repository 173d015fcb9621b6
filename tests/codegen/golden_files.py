"""Comparison of rendered files with those kept in ``golden/``."""

from __future__ import annotations

import difflib
from pathlib import Path

GOLDEN = Path(__file__).parent / "golden"


def check_golden(name: str, files: dict[str, str], update: bool) -> None:
    """Fail with the difference between rendered files and a golden directory; with `update` write it first."""
    folder = GOLDEN / name
    if update:
        for path, text in files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
    kept = {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}
    difference = [
        line
        for path in sorted(kept.keys() | files.keys())
        for line in difflib.unified_diff(
            kept.get(path, "").splitlines(), files.get(path, "").splitlines(), f"golden/{path}", path, lineterm=""
        )
    ]
    assert not difference, "\n".join(["run pytest --update-golden if intended:", *difference])
