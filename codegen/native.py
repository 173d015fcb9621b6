"""The generated controller, compiled for the host and called through cffi (ABI mode)."""

from __future__ import annotations

import platform
import re
import tempfile
from pathlib import Path
from typing import Any

import cffi
import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.firmware_number import interface_hash
from mimopilot.codegen.layout import GAINS, INPUT, OUTPUT, STATE, gains_array, input_rows, to_array
from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.targets import TEMPLATES
from mimopilot.codegen.toolchain import CXX_FLAGS, compile_shared, find_compiler
from mimopilot.common.cache import cache_folder
from mimopilot.common.files import inside, seal, sha256, unseal, write_atomically
from mimopilot.tuning.gains import Gains, gains_to_toml

HEADER = TEMPLATES / "native" / "mimo_pid_native.h"
SOURCES = ("core/mimo_pid.cpp", "native/mimo_pid_native.cpp")

#: What mimo_pid_layout(item) must return, in the order of the header's enum.
LAYOUT = (
    GAINS.itemsize,
    INPUT.itemsize,
    OUTPUT.itemsize,
    STATE.itemsize,
    INPUT.fields["rates"][1],  # type: ignore[index]
    INPUT.fields["saturation"][1],  # type: ignore[index]
    INPUT.fields["landed"][1],  # type: ignore[index]
    OUTPUT.fields["fault"][1],  # type: ignore[index]
    STATE.fields["integral"][1],  # type: ignore[index]
)


#: Hash of the gains, compiler and cache folder -> library that this process built or found: a flight renders nothing.
_BUILT: dict[tuple[str, str, Path] | None, Path] = {}


def build_native(gains: Gains, folder: Path | None = None) -> Path:
    """Emit the native target and compile it into a shared library.

    Parameters
    ----------
    gains : Gains
        Default gains of the library.
    folder : Path, optional
        For the source tree and the library; by default only the library is kept, in the cache.

    Returns
    -------
    Path
        The library. Its name contains the hash of its sources and flags, so a changed library is never mistaken
        for one already loaded.

    Raises
    ------
    CodegenError
        If there is no compiler or it fails, or the folder holds files that were not generated.
    """
    compiler = find_compiler()
    known = None if folder else (sha256(gains_to_toml(gains)), compiler, cache_folder())
    if known in _BUILT and _whole(_BUILT[known]):
        return _BUILT[known]
    files = render(gains, "native")
    sources = "".join(
        f"{name}\0{content}\0" for name, content in files.items() if name.startswith(("core/", "native/"))
    )
    key = sha256(f"{sources}{compiler}{CXX_FLAGS}{platform.machine()}")[:16]
    name = f"libmimo_pid-{key}.so"
    if folder is not None:
        write_tree(files, folder)
        library = inside(folder, f"build/{name}")
    else:
        library = cache_folder() / name
    if not _whole(library):
        with tempfile.TemporaryDirectory() as scratch:  # other processes may be building the same library
            tree = Path(scratch)
            write_tree(files, tree)
            compile_shared(compiler, [tree / source for source in SOURCES], tree / name)
            write_atomically(library, seal((tree / name).read_bytes(), name))  # the loader ignores appended bytes
    if known is not None:
        _BUILT[known] = library
    return library


def _whole(library: Path) -> bool:
    """Whether a library is undamaged: loading a damaged one could crash the process."""
    try:
        found = unseal(library.read_bytes())
    except OSError:
        return False
    return found is not None and found[1] == library.name


def _declarations() -> str:
    """Function declarations of the C header, for cffi."""
    text = re.sub(r"/\*.*?\*/", "", HEADER.read_text(), flags=re.DOTALL)
    return "\n".join(re.findall(r"^(?:uint32_t|int32_t|void) \w+\([^)]*\);", text, flags=re.MULTILINE))


class NativeLibrary:
    """A loaded library, its interface checked.

    Parameters
    ----------
    path : Path
        What `build_native` returned.

    Raises
    ------
    CodegenError
        When it cannot be loaded, or its interface is not the one that this version expects.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ffi = cffi.FFI()
        self.ffi.cdef(_declarations())
        try:
            self.lib: Any = self.ffi.dlopen(str(path))
        except OSError as error:
            raise CodegenError(f"{path}: cannot load the compiled controller: {error}", exit_code=1) from error
        if self.lib.mimo_pid_interface_hash() != interface_hash():
            raise CodegenError(f"{path}: made for another version of the interface; delete it and generate again")
        layout = tuple(self.lib.mimo_pid_layout(item) for item in range(len(LAYOUT)))
        if layout != LAYOUT:
            raise CodegenError(f"{path}: sizes and offsets are {layout}, expected {LAYOUT}; generate again")

    def default_gains(self) -> NDArray[np.float32]:
        """Default gains of the library, (len(PARAMETERS),) float32."""
        gains = np.zeros(GAINS.shape, np.float32)
        self.lib.mimo_pid_default_gains(self.ffi.from_buffer("float[]", gains))
        return gains


class NativeController:
    """One controller of a loaded library, with its own state.

    Parameters
    ----------
    library : NativeLibrary
        The loaded library.
    gains : Gains or None
        The initial gains; None: the library's defaults.
    """

    def __init__(self, library: NativeLibrary, gains: Gains | None = None) -> None:
        self.library = library
        self.state: NDArray[Any] = np.zeros(1, STATE)
        self._state = library.ffi.from_buffer("uint8_t[]", self.state)
        array = library.default_gains() if gains is None else to_array(gains)
        if not library.lib.mimo_pid_initialise(self._state, library.ffi.from_buffer("float[]", array)):
            raise CodegenError(
                "the controller refused its gains: each must be finite and within its range; correct the gains file"
            )

    @property
    def step_address(self) -> int:
        """Address of mimo_pid_step, for calls from compiled loops."""
        ffi = self.library.ffi
        return int(ffi.cast("uintptr_t", ffi.addressof(self.library.lib, "mimo_pid_step")))

    def set_gains(self, gains: Gains | NDArray[np.float32]) -> bool:
        """Change the gains, bumpless. False: refused, the old gains are kept.

        Parameters
        ----------
        gains : Gains or (len(PARAMETERS),) float32 array
            The new gains.
        """
        array = gains_array(gains)
        return bool(self.library.lib.mimo_pid_set_gains(self._state, self.library.ffi.from_buffer("float[]", array)))

    def run(self, inputs: NDArray[Any]) -> NDArray[Any]:
        """Run consecutive control periods.

        Parameters
        ----------
        inputs : (N,) array of `codegen.layout.INPUT`
            One row per period.

        Returns
        -------
        (N,) array of `codegen.layout.OUTPUT`
        """
        rows = input_rows(inputs)
        outputs = np.zeros(len(rows), OUTPUT)
        ffi = self.library.ffi
        self.library.lib.mimo_pid_run(
            self._state, ffi.from_buffer("uint8_t[]", rows), ffi.from_buffer("uint8_t[]", outputs), len(rows)
        )
        return outputs


def load_native(gains: Gains, folder: Path | None = None) -> NativeLibrary:
    """Build the library with `build_native` and load it."""
    return NativeLibrary(build_native(gains, folder))
