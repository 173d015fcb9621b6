"""From a log to gains: read, inspect, tune, certify, advise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mimopilot.api.arguments import given_columns, given_experiment, given_gains, given_spec
from mimopilot.common.blas import reproducible

if TYPE_CHECKING:
    from mimopilot.api.arguments import GainSet, Log, Model, PathLike
    from mimopilot.tuning.design.advise import Advice
    from mimopilot.tuning.experiment import Experiment
    from mimopilot.tuning.gains import Gains
    from mimopilot.tuning.logs.inspection import Inspection
    from mimopilot.tuning.spec import TuningSpec


@reproducible
def read_log(path: PathLike, columns: PathLike | None = None) -> Experiment:
    """Read an experiment from a flight log.

    Parameters
    ----------
    path : str or Path
        PX4 ULog, ArduPilot dataflash, CSV or MATLAB file.
    columns : str or Path, optional
        Names, units and signs of the columns of a CSV or MATLAB file (TOML).

    Returns
    -------
    Experiment
        The signals in SI units; what is doubtful about the log is in its `warnings`.

    Raises
    ------
    Error
        When the file is no flight log, is damaged, lacks a signal, or its columns contradict one another.
    """
    from mimopilot.tuning.logs.reader import read_log as read

    return read(Path(path), given_columns(columns))


@reproducible
def inspect(path: PathLike, columns: PathLike | None = None) -> Inspection:
    """Say what is in a log, and whether gains can be tuned from it.

    Parameters
    ----------
    path, columns
        As in `read_log`.

    Returns
    -------
    Inspection
        Its `reason` is None when gains can be tuned.

    Raises
    ------
    Error
        When the file is no flight log or damaged.
    """
    from mimopilot.tuning.logs.inspection import inspect_log

    return inspect_log(Path(path), given_columns(columns))


@reproducible
def tune(
    log: Log | Sequence[Log],
    *,
    inner: Model | None = None,
    outer: Model | None = None,
    spec: PathLike | TuningSpec | None = None,
    repeat: Log | None = None,
    columns: PathLike | None = None,
    **options: Any,
) -> Gains:
    """Find the best gains of the attitude cascade from one flight, or from several of one vehicle.

    Parameters
    ----------
    log : str, Path or Experiment, or a list of them
        Flight with excitation.
    inner, outer : tuple, optional
        Reference models of the rate and the attitude loop: (omega rad/s, damping, delay samples). With one of them
        VRFT finds the gains for the models, as in the thesis.
    spec : str, Path or TuningSpec, optional
        Specification; TOML where it is a path. What is given here overrides it.
    repeat : str, Path or Experiment, optional
        Second flight of the same experiment, for the instrument ``repeated``.
    columns : str or Path, optional
        As in `read_log`.
    **options
        Further entries of `tuning.spec.TuningSpec`: ``profile``, ``method``, ``structure``, ``instrument``...

    Returns
    -------
    Gains
        With their certificate, standard deviations and warnings. `provenance.details` holds the predicted figures of
        these and the flown gains: ``predicted``, ``better_than_flown``, ``keep_flown``; those of yaw in ``yaw``, or why
        its gains are kept: ``kept``; for a stock controller also what our module's would do,
        ``worth_of_off_diagonals``.

    Raises
    ------
    Error
        When the log cannot be read or tuned from, an option is unknown, or the gains would be unstable.
    """
    from mimopilot.tuning.design.cascade import tune as tune_cascade

    task = given_spec(spec, {"inner": inner, "outer": outer, **options})
    second = None if repeat is None else given_experiment(repeat, columns)
    logs: Sequence[Log] = log if isinstance(log, list | tuple) else [log]  # type: ignore[list-item]
    return tune_cascade([given_experiment(one, columns) for one in logs], task, repeat=second)


@reproducible
def certify(
    log: Log,
    gains: GainSet,
    *,
    rate: float | None = None,
    spec: PathLike | TuningSpec | None = None,
    columns: PathLike | None = None,
) -> Gains:
    """Check the stability of the closed loop, from a flight of the vehicle with any gains.

    Parameters
    ----------
    log : str, Path or Experiment
    gains : str, Path or Gains
        Set to examine.
    rate : float, optional, Hz
        Carry the gains to this control rate first. None: their own. Either may differ from that of the log.
    spec : str, Path or TuningSpec, optional
        Whose ``certificate`` says which margins are needed.
    columns : str or Path, optional
        As in `read_log`.

    Returns
    -------
    Gains
        The set with its new certificate: see `Gains.verdict` and `Gains.certificate`.

    Raises
    ------
    Error
        When the log or the gains cannot be read, or do not belong together.
    """
    from mimopilot.tuning.design.cascade import at_rate, certify_from_log

    examined = given_gains(gains) if rate is None else at_rate(given_gains(gains), rate)
    return certify_from_log(given_experiment(log, columns), examined, given_spec(spec, {}))


@reproducible
def advise(
    log: Log,
    *,
    spec: PathLike | TuningSpec | None = None,
    columns: PathLike | None = None,
    watch: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> Advice:
    """Design the gains as `tune` does, and the alternatives around them.

    Parameters
    ----------
    log : str, Path or Experiment
    spec, columns
        As in `tune`.
    watch : callable
        Wraps the iteration over the alternatives, for a progress bar.

    Returns
    -------
    Advice
        Its `recommended` candidate holds the gains that `tune` finds.

    Raises
    ------
    Error
        When the log cannot be tuned from, or no gains are certified.
    """
    from mimopilot.tuning.design.advise import advise as scan

    return scan(given_experiment(log, columns), given_spec(spec, {}), watch=watch)


def load_gains(path: PathLike) -> Gains:
    """Read a gains file; `Gains.save` writes one.

    Parameters
    ----------
    path : str or Path
        ``*.gains.toml``.

    Returns
    -------
    Gains

    Raises
    ------
    Error
        When the file cannot be read, or a value is missing or wrong.
    """
    from mimopilot.tuning.gains_file import load_gains as load

    return load(path)
