"""The fault table as printed by `mimopilot faults`."""

from __future__ import annotations

from mimopilot.common.console import print_table, print_text
from mimopilot.sitl.studies.fault_table import FaultTable, FaultTableRow

COLUMNS = (
    *("fault", "gains", "survived", "95 % interval", "peak [deg]", "worst [deg]", "RMS [deg]", "recovered [s]"),
    *("saturated samples", "detected [s]", "non-finite outputs"),
)


def print_fault_table(table: FaultTable) -> None:
    """Print the table, the flights without faults, and the commands that repeat the worst flights."""
    print_table(table.title, COLUMNS, [_cells(row) for row in table.rows])
    for name, lost in table.lost_without.items():
        runs = next(row.runs for row in table.rows if row.gains == name)
        print_text(f"without faults, {name}: {lost} of {runs} lost, {table.alarms_without[name]} with a false alarm")
    print("commands to repeat the worst flights:")
    for row in table.rows:
        print(f"  {row.replay}")


def _cells(row: FaultTableRow) -> list[str]:
    low, high = row.survival_interval

    def some(value: float | None, count: int) -> str:
        return "-" if value is None else f"{value:.3f}" + ("" if count == row.runs else f" ({count})")

    return [
        row.fault,
        row.gains,
        f"{row.survived}/{row.runs}",
        f"{low:.2f}-{high:.2f}",
        f"{row.peak_deg:.2f}",
        f"{row.worst_peak_deg:.2f}",
        f"{row.rms_deg:.2f}",
        some(row.recovery_s, row.recovered),
        f"{row.saturated:g}",
        some(row.detected_s, row.detected) + f" {row.detected_by}".rstrip(),
        str(row.nonfinite),
    ]
