"""Storage of the vehicle's changed parameters: a QGroundControl parameter file.

Like a real vehicle's memory, it holds only what differs from the defaults: the gains that the vehicle was started
with. A few fixed parameters identify the vehicle. A thread writes the file: the control loop never waits for a disk.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path

from mimopilot.common.files import write_atomically
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text, read_parameters

#: Delay from a change to its write, s; chosen: changes that follow are written together.
DELAY_S = 0.2


class ParameterStore:
    """One parameter file.

    Parameters
    ----------
    path : Path
        The file; it may not exist yet.

    Attributes
    ----------
    held : dict
        Name -> value, as read at the start.

    Raises
    ------
    Error
        When the file is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.held = read_parameters(path) if path.exists() else {}
        self._wanted: Mapping[str, float] | None = None
        self._write_error = ""
        self._changed, self._leaving = threading.Event(), threading.Event()
        # `_writing` is held during a write, `_taking` only for an assignment.
        self._writing, self._taking = threading.Lock(), threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def keep(self, values: Mapping[str, float]) -> None:
        """Schedule these values to be written; returns at once."""
        with self._taking:
            self._wanted = dict(values)
        self._changed.set()

    def flush(self) -> bool:
        """Write pending values now; False when that fails."""
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
                self._write_error = f"parameters not stored: {error.filename}: {error.strerror}"
                return False
            return True

    def take_write_error(self) -> str:
        """Return the last write error and clear it; empty: none."""
        taken, self._write_error = self._write_error, ""
        return taken

    def close(self) -> None:
        """Write pending values and end the thread.

        Raises
        ------
        SitlError
            When that fails.
        """
        self._leaving.set()
        self._changed.set()
        self._thread.join()
        if not self.flush():
            raise SitlError(self.take_write_error(), exit_code=1)

    def _run(self) -> None:
        while not self._leaving.is_set():
            self._changed.wait()
            self._leaving.wait(DELAY_S)
            self._changed.clear()
            self.flush()


class KeptParameters:
    """Parameters of a vehicle that are stored, or not.

    Attributes
    ----------
    store : ParameterStore or None
        None: they are lost with the process.
    """

    store: ParameterStore | None

    def flush(self) -> bool:
        """Store pending changes now; False when that fails."""
        return self.store is None or self.store.flush()

    def take_write_error(self) -> str:
        """Return the store's last write error and clear it; empty: none."""
        return self.store.take_write_error() if self.store else ""

    def close(self) -> None:
        """Store pending changes."""
        if self.store is not None:
            self.store.close()
