"""Where a simulated vehicle keeps what ground stations change: a QGroundControl parameter file.

It holds what differs from the gains that the vehicle was started with, as a real one's memory holds what differs
from its firmware's defaults, and a few fixed parameters that tell whose it is. A thread writes it: the control
loop never waits for a disk.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text, read_parameters

from mimopilot.common.files import write_atomically

#: A change is written so long after it, s: others that come with it are written together.
DELAY_S = 0.2


class ParameterStore:
    """One such file.

    Parameters
    ----------
    path : Path
        It need not be there yet.

    Attributes
    ----------
    held : dict
        Name -> value of what it held at the start.

    Raises
    ------
    SitlError
        When it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.held = read_parameters(path) if path.exists() else {}
        self._wanted: Mapping[str, float] | None = None
        self._complaint = ""
        self._changed, self._leaving = threading.Event(), threading.Event()
        self._writing, self._taking = threading.Lock(), threading.Lock()  # the first is held for long, by writers only
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def keep(self, values: Mapping[str, float]) -> None:
        """Write these soon; returns at once."""
        with self._taking:
            self._wanted = dict(values)
        self._changed.set()

    def flush(self) -> bool:
        """Write now what was not written yet; False when that fails."""
        with self._writing:
            with self._taking:
                wanted, self._wanted = self._wanted, None
            if wanted is None:
                return True
            try:
                write_atomically(self.path, parameter_text("qgc", wanted, checksum=False))
            except OSError as error:
                with self._taking:
                    self._wanted = self._wanted or wanted
                self._complaint = f"parameters not kept: {error.filename}: {error.strerror}"
                return False
            return True

    def complaint(self) -> str:
        """Why writing failed, told once; empty when nothing has."""
        told, self._complaint = self._complaint, ""
        return told

    def close(self) -> None:
        """Write what was not written yet.

        Raises
        ------
        SitlError
            When that fails.
        """
        self._leaving.set()
        self._changed.set()
        self._thread.join()
        if not self.flush():
            raise SitlError(self.complaint(), exit_code=1)

    def _run(self) -> None:
        while not self._leaving.is_set():
            self._changed.wait()
            self._leaving.wait(DELAY_S)
            self._changed.clear()
            self.flush()
