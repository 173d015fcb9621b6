"""The field guide quotes messages that the program has."""

import ast
import re

import pytest

from tests.paths import DOCS, PACKAGES

ROWS = re.findall(r"^\| `([^`]+)` \|", (DOCS / "field-guide.md").read_text(), re.MULTILINE)


def texts():
    """All texts of the program; the pieces of one message are joined, and a value in it is a line break."""
    for package, folder in PACKAGES.items():
        if package == "mimopilot.firmware_templates":
            continue
        for path in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value
                elif isinstance(node, ast.JoinedStr):
                    yield "".join(str(part.value) if isinstance(part, ast.Constant) else "\n" for part in node.values)


@pytest.fixture(scope="module")
def messages():
    return "\0".join(texts())


def test_there_are_rows():
    assert len(ROWS) > 25


@pytest.mark.parametrize("row", ROWS)
def test_a_quoted_message_is_one_of_the_program(row, messages):
    assert row in messages
