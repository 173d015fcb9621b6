"""What a user of `autotune` sees: steps, tables and questions."""

from __future__ import annotations

import select
import sys
import time

from mimopilot.common.console import print_table
from mimopilot.sitl.field.autotune_report import CHECK_CAPTION, CHECKED, check_rows
from mimopilot.sitl.field.autotune_run import FLIGHT
from mimopilot.sitl.field.check_flight import CheckResult
from mimopilot.tuning.design.prediction_rows import PREDICTED, predicted_rows
from mimopilot.tuning.gains import Gains

YES, NO = ("y", "yes"), ("n", "no")


class AutotuneTerminal:
    """Lines, tables and questions on the terminal; with `quiet` nothing but the questions.

    Attributes
    ----------
    interactive : bool
        Standard input is a terminal.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.interactive = sys.stdin.isatty()

    def tell(self, text: str) -> None:
        """Print a line."""
        if not self.quiet:
            print(f"autotune: {text}", flush=True)

    def ask(self, question: str, seconds: float | None = None) -> bool | None:
        """Ask until the answer is yes or no; None: no answer in time (s), or the input has ended."""
        end = None if seconds is None else time.monotonic() + seconds
        while True:
            print(f"{question} [y/n]: ", end="", flush=True, file=sys.stderr)
            left = None if end is None else max(0.0, end - time.monotonic())
            if not select.select([sys.stdin], [], [], left)[0]:
                print(file=sys.stderr)
                return None
            line = sys.stdin.readline()
            if not line:
                return None
            answer = line.strip().lower()
            if answer in (*YES, *NO):
                return answer in YES

    def show_gains(self, gains: Gains) -> None:
        """Print what the flown and the new gains are predicted to do, and the certificate."""
        if self.quiet:
            return
        title = "predicted, roll / pitch: RMS over doublets of 10 degrees, after a torque step, of the torque at hover"
        print_table(title, PREDICTED, predicted_rows(gains, [FLIGHT]))
        verdict, reason = gains.verdict()
        print(f"certificate: {verdict}: {reason}", flush=True)

    def show_check(self, result: CheckResult) -> None:
        """Print the check flight beside its prediction."""
        if not self.quiet:
            print_table(CHECK_CAPTION, CHECKED, check_rows(result))


class SilentAnswers:
    """A dialogue without a user: every question has the same answer."""

    interactive = False

    def __init__(self, answer: bool = True) -> None:
        self.answer = answer

    def tell(self, text: str) -> None:
        """Nothing."""

    def ask(self, question: str, seconds: float | None = None) -> bool | None:
        """The answer."""
        return self.answer

    def show_gains(self, gains: Gains) -> None:
        """Nothing."""

    def show_check(self, result: CheckResult) -> None:
        """Nothing."""
