"""Whether what a command prints is readable at any width of the terminal; the command itself runs once."""

from mimopilot.common import console
from mimopilot.common.text_table import UNBROKEN, folded, plain_zero, text_table

#: Columns of the terminal; None: a pipe.
WIDTHS = (60, 80, 120, None)


class Printed:
    """The tables and texts that commands print from now on, in a terminal of 80 columns."""

    def __init__(self, monkeypatch):
        self.tables, self.texts = [], []
        monkeypatch.setattr(console, "text_table", lambda *table: self.tables.append(table) or text_table(*table))
        monkeypatch.setattr(console, "folded", lambda text, width: self.texts.append(text) or folded(text, width))
        monkeypatch.setenv("COLUMNS", "80")

    def check(self, output, tables=True):
        """Everything in the output fits 80 columns, and its tables and texts, set again, any other width."""
        assert bool(self.tables) == tables
        for columns, rows, width in self.tables:
            assert width == 80
            assert "\n".join(text_table(columns, rows, 80)) in output
            cells = [plain_zero(word) for row in (columns, *rows) for cell in row for word in cell.split()]
            for width in WIDTHS:
                text = text_table(columns, rows, width)
                assert width is None or max(map(len, text)) <= width
                # Words are whole unless they are longer than any column could be.
                words = " ".join(text).split()
                assert not [
                    word for word in cells if len(word) <= UNBROKEN and word not in words and f"{word}:" not in words
                ]
        for text in self.texts:
            for width in WIDTHS:
                lines = folded(text, width)
                # Only a path or an address may be longer, so that it can be copied.
                assert all(width is None or len(line) <= width or " " not in line.strip() for line in lines)
                assert " ".join(lines).split() == plain_zero(text).split()
        assert "…" not in output
        # Commands and paths are not broken, so that they can be copied.
        long = [line for line in output.splitlines() if len(line) > 80 and " " in line.strip()]
        assert not [line for line in long if not line.strip().startswith("mimopilot ")], long
        assert not [line for line in output.splitlines() if line != plain_zero(line)]
