"""Who imports whom among the folders of sitl/mavlink."""

import re

from tests.paths import PACKAGES

ORDER = ("wire", "simulator_api", "vehicle", "ground_station")


def test_a_folder_imports_only_from_earlier_ones():
    for place, folder in enumerate(ORDER):
        for path in (PACKAGES["mimopilot.sitl"] / "mavlink" / folder).glob("*.py"):
            imported = set(re.findall(r"^\s*from mimopilot\.sitl\.mavlink\.(\w+)", path.read_text(), re.MULTILINE))
            assert imported <= set(ORDER[: place + 1]), path
