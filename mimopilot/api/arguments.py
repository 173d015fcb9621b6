"""Arguments of the public functions: a path, or what would be read from it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mimopilot.sitl.physics.airframe import Airframe
    from mimopilot.tuning.experiment import Experiment
    from mimopilot.tuning.gains import Gains
    from mimopilot.tuning.logs.columns import Columns
    from mimopilot.tuning.reference_model import ContinuousModel
    from mimopilot.tuning.spec import TuningSpec

    PathLike = str | Path
    Log = PathLike | Experiment
    GainSet = PathLike | Gains
    Model = tuple[float, float] | tuple[float, float, int] | ContinuousModel


def given_experiment(log: Log, columns: PathLike | None) -> Experiment:
    """The experiment, read where it is a log's path."""
    from mimopilot.tuning.logs.reader import read_log as read

    return read(Path(log), given_columns(columns)) if isinstance(log, str | Path) else log


def given_gains(gains: GainSet) -> Gains:
    """The gains, read where they are a file's path."""
    from mimopilot.tuning.gains_file import load_gains

    return load_gains(gains) if isinstance(gains, str | Path) else gains


def given_columns(path: PathLike | None) -> Columns | None:
    """The description of a log's columns; None: not given."""
    from mimopilot.tuning.logs.columns import load_columns

    return None if path is None else load_columns(Path(path))


def given_spec(spec: PathLike | TuningSpec | None, overrides: Mapping[str, Any]) -> TuningSpec:
    """The specification with those entries replaced that are not None."""
    from mimopilot.tuning.spec import load_spec

    given = {name: value for name, value in overrides.items() if value is not None}
    if spec is None or isinstance(spec, str | Path):
        return load_spec(None if spec is None else Path(spec), **given)
    return load_spec(None, **{**{name: getattr(spec, name) for name in spec.model_fields_set}, **given})


def given_vehicle(airframe: PathLike | Airframe, gains: GainSet | None = None) -> tuple[Airframe, Gains]:
    """An airframe and the gains that fly it, by default its own."""
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.physics.airframe import load_airframe as load

    if not isinstance(airframe, str | Path):
        if gains is None:
            raise SitlError(f"gains: an airframe that is no file ({airframe.name}) has none of its own; give them")
        return airframe, given_gains(gains)
    loaded = load(str(airframe))
    return loaded.airframe, loaded.default_gains() if gains is None else given_gains(gains)
