"""Long work in pieces: on all cores, with progress, each finished piece kept, so that it can be resumed.

Give `run_pieces` a list of pieces and a folder. Each piece is a function of one argument that returns a JSON value; it
runs in a worker process. The results are kept in the folder's `parts`; the same call goes on where it was interrupted.

    pieces = [Piece(f"run-{seed}", fly_one, (study, seed), inputs=repr((study, seed))) for seed in range(500)]
    pieces.append(Piece("table", make_table, study, inputs=repr(study), after=tuple(piece.name for piece in pieces)))
    table = run_pieces(pieces, out, workers, "reproduce vehicles")["table"]
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from mimopilot.common.errors import Error
from mimopilot.common.files import inside, seal, sha256
from mimopilot.common.parallel import processes
from mimopilot.common.part_folder import RESUME, PartFolder, folder_lock
from mimopilot.common.progress import progress

PARTS, LOCK = "parts", "parts.lock"
#: What determines a result: packages in different folders, and the C++ beside the last one.
PACKAGES, CPP = ("mimopilot", "mimopilot.tuning", "mimopilot.sitl", "mimopilot.codegen"), "firmware_templates"
COMPILED = (".pyc", ".nbi", ".nbc")  # by Python and numba, beside the sources


@dataclass(frozen=True, eq=False)
class Piece:
    """One piece of long work.

    Attributes
    ----------
    name : str
        Unique; also the name of its file.
    function : callable
        Of `argument` and the results of `after`, in that order. It returns a JSON value, which depends on these, on
        `inputs` and on the program alone. It and the argument are pickled.
    argument : object
    inputs : str
        All that the result depends on besides the program and the results of `after`, as text.
    after : tuple of str
        Names of earlier pieces whose results it takes.
    """

    name: str
    function: Callable[..., Any]
    argument: Any
    inputs: str
    after: tuple[str, ...] = ()


def run_pieces(
    pieces: Sequence[Piece],
    folder: Path,
    workers: int,
    what: str,
    kept: Callable[[str, Any], None] = lambda name, result: None,
) -> dict[str, Any]:
    """Run all pieces that the folder does not hold, and keep each result at once.

    Parameters
    ----------
    pieces : sequence of Piece
        Where several can run, earlier ones run first.
    folder : Path
        Output folder; the results are kept in its `parts`. A result with other inputs, or of another version of the
        program, is not used.
    workers : int
        Processes. The results do not depend on it.
    what : str
        The work, for progress and messages.
    kept : callable
        Called in this process with each name and result, also with those that the folder held.

    Returns
    -------
    dict
        Name -> result, in the order of the pieces.

    Raises
    ------
    Error
        When the folder is in use, or workers were lost; exit code 130 after Ctrl-C, which kills running pieces.
    """
    parts, labels = PartFolder(inside(folder, PARTS), "version or set of options"), _labels(pieces)
    for piece in pieces:
        parts.path(piece.name)  # a link is found before anything is written
    results: dict[str, Any] = {}

    def keep(piece: Piece, text: bytes) -> None:
        results[piece.name] = json.loads(text)
        kept(piece.name, results[piece.name])

    with folder_lock(folder, LOCK, "study"):
        missing = set(parts.missing(labels.items()))
        left = []
        for piece in pieces:
            if piece.name in missing:
                left.append(piece)
            else:
                keep(piece, parts.read(piece.name, labels[piece.name]))

        def finish(piece: Piece, text: bytes) -> None:
            parts.write(piece.name, seal(text, labels[piece.name]))
            keep(piece, text)

        if left:
            try:
                with processes(workers) as executor, progress(what, len(pieces), len(results)) as advance:
                    _run_in_order(left, executor, workers, results, finish, advance)
            except KeyboardInterrupt:
                raise Error(
                    f"interrupted after {len(results)} of {len(pieces)} pieces; {RESUME}", exit_code=130
                ) from None
            except BrokenProcessPool:
                raise Error(f"a worker process was killed, perhaps for lack of memory; {RESUME}", exit_code=1) from None
    return {piece.name: results[piece.name] for piece in pieces}


def _run_in_order(
    left: list[Piece],
    executor: Executor,
    workers: int,
    results: Mapping[str, Any],
    finish: Callable[[Piece, bytes], None],
    advance: Callable[[], None],
) -> None:
    """Run pieces as soon as a worker and the results that they take are there."""
    running: dict[Future[bytes], Piece] = {}
    while left or running:
        ready = (piece for piece in left if all(name in results for name in piece.after))
        for piece in [next(ready, None) for _ in range(workers - len(running))]:
            if piece is not None:
                left.remove(piece)
                call = partial(_as_text, piece.function, piece.argument, *(results[name] for name in piece.after))
                running[executor.submit(call)] = piece
        if not running:
            raise ValueError(f"{left[0].name}: needs {', '.join(left[0].after)}, which are not among the pieces")
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            finish(running.pop(future), future.result())
            advance()


def _as_text(function: Callable[..., Any], *arguments: Any) -> bytes:
    """Result of a piece as JSON text: floats are restored to the bit, infinite ones too."""
    return json.dumps(function(*arguments)).encode()


def _labels(pieces: Sequence[Piece]) -> dict[str, str]:
    """Name -> label of each piece: a digest of the program, the inputs, and the labels of those it comes after."""
    labels: dict[str, str] = {}
    for piece in pieces:
        given = [program_digest(), piece.name, piece.inputs, *(labels[name] for name in piece.after)]
        labels[piece.name] = f"{sha256(json.dumps(given))} {piece.name}"
    return labels


@cache
def program_digest() -> str:
    """SHA-256 of every file of the program: with another version, even an edited one, results are computed again."""
    folders = []
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        folders += [Path(place).resolve() for place in (spec and spec.submodule_search_locations) or ()]
    digest = hashlib.sha256()
    for folder in (*folders, folders[-1].parent / CPP):
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.suffix not in COMPILED:
                digest.update(f"{folder.name}/{path.relative_to(folder).as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()
