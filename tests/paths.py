"""Where the project's own files lie."""

from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
DATA = TOP / "tests" / "data"
#: The manual's pages, as far as they are written by hand.
DOCS = TOP / "docs"
#: The packages' folders, by the name that each imports by.
PACKAGES = {
    "mimopilot": TOP / "mimopilot",
    "mimopilot.tuning": TOP / "tuning",
    "mimopilot.codegen": TOP / "codegen",
    "mimopilot.firmware_templates": TOP / "firmware_templates",
    "mimopilot.sitl": TOP / "sitl",
}
