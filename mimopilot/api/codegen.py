"""From gains to C++."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mimopilot.api.arguments import given_gains

if TYPE_CHECKING:
    from mimopilot.api.arguments import GainSet, PathLike


class GeneratedTree(NamedTuple):
    """What `generate` wrote.

    Attributes
    ----------
    files : list of Path
        All files of the tree, also those that were up to date.
    written : list of Path
        Those that were written.
    warnings : list of str
        What is doubtful about the stability of the gains, and a control rate that is not the target's.
    """

    files: list[Path]
    written: list[Path]
    warnings: list[str]


def generate(
    gains: GainSet,
    out: PathLike,
    *,
    target: str = "native",
    force: bool = False,
    uncertified: bool = False,
    **options: str,
) -> GeneratedTree:
    """Emit the C++ controller with its gains, parameter table, build files and tests.

    Parameters
    ----------
    gains : str, Path or Gains
    out : str or Path
        Folder to write to.
    target : str
        Name of a target, `codegen.targets.targets`: ``native``, ``px4``, ``cortex-m4`` ...
        Gains for another control rate than the target's are emitted with a warning.
    force : bool
        Overwrite files that mimopilot did not generate.
    uncertified : bool
        Accept gains whose stability is in doubt.
    **options : str
        Options of the target, such as ``px4_api``: ``crtp`` up to v1.17, ``descriptor`` later.

    Returns
    -------
    GeneratedTree

    Raises
    ------
    Error
        When the target or an option is unknown, a gain is out of its range, the gains are not certified, or the
        folder holds files of somebody else.
    """
    from mimopilot.codegen.render import render, write_tree
    from mimopilot.codegen.targets import find_target
    from mimopilot.tuning.acceptance import check_verdict

    loaded, chosen = given_gains(gains), find_target(target)
    warnings = [check_verdict(loaded, allow=uncertified), chosen.rate_warning(loaded), chosen.shaping_warning(loaded)]
    files = render(loaded, target, **options)
    written = write_tree(files, Path(out), force)
    return GeneratedTree(
        [Path(out) / name for name in files], [Path(out) / name for name in written], list(filter(None, warnings))
    )
