"""What `import mimopilot` offers: one function for each thing that the command line does.

Paths may be `str` or `Path`. Every function raises `mimopilot.Error` for what its caller can correct, and gives the
same bits as the command of its name.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from mimopilot.common.blas import reproducible
from mimopilot.common.errors import check_choice

if TYPE_CHECKING:
    from mimopilot.sitl.field.autotune_run import AutotuneDialogue
    from mimopilot.sitl.field.decisions import Decisions
    from mimopilot.sitl.field.report.flight_report import FlightReport
    from mimopilot.sitl.flight.metrics import Performance
    from mimopilot.sitl.flight.scenario import Scenario
    from mimopilot.sitl.flight.simulator import Flight
    from mimopilot.sitl.mavlink.ground_station.profiles import UploadPlan
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.mavlink.ground_station.upload import UploadOutcome
    from mimopilot.sitl.mavlink.log_transfer.vehicle_logs import Download, VehicleLog
    from mimopilot.sitl.physics.airframe import Airframe
    from mimopilot.tuning.design.advise import Advice
    from mimopilot.tuning.experiment import Experiment
    from mimopilot.tuning.gains import Gains, Triple
    from mimopilot.tuning.logs.columns import Columns
    from mimopilot.tuning.logs.imported_gains import ImportedGains
    from mimopilot.tuning.logs.inspection import Inspection
    from mimopilot.tuning.reference_model import ContinuousModel
    from mimopilot.tuning.spec import TuningSpec

    PathLike = str | Path
    Log = PathLike | Experiment
    GainSet = PathLike | Gains
    Model = tuple[float, float] | tuple[float, float, int] | ContinuousModel


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

    return read(Path(path), _columns(columns))


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

    return inspect_log(Path(path), _columns(columns))


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

    task = _spec(spec, {"inner": inner, "outer": outer, **options})
    second = None if repeat is None else _experiment(repeat, columns)
    logs: Sequence[Log] = log if isinstance(log, list | tuple) else [log]  # type: ignore[list-item]
    return tune_cascade([_experiment(one, columns) for one in logs], task, repeat=second)


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

    examined = _gains(gains) if rate is None else at_rate(_gains(gains), rate)
    return certify_from_log(_experiment(log, columns), examined, _spec(spec, {}))


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

    return scan(_experiment(log, columns), _spec(spec, {}), watch=watch)


@reproducible
def report(
    logs: PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    gains: GainSet | Sequence[GainSet] = (),
    figures: PathLike | None = None,
    spec: PathLike | TuningSpec | None = None,
    columns: PathLike | None = None,
) -> FlightReport:
    """Write the report of a flight: one page with interactive figures, which needs no network.

    Parameters
    ----------
    logs : str or Path, or a list of them
        Any flight logs, also such that gains cannot be tuned from; the first is the one before.
    out : str or Path
        The page (HTML).
    gains : str, Path or Gains, or a list of them
        Shown beside the flown gains.
    figures : str or Path, optional
        Folder for the same figures as PNG and SVG.
    spec : str, Path or TuningSpec, optional
        Whose ``certificate`` says which margins are needed.
    columns : str or Path, optional
        As in `read_log`.

    Returns
    -------
    FlightReport
        What was written: headline, sections with their tables and figures, gain sets with their certificates.

    Raises
    ------
    Error
        When a file is no flight log or damaged, or the gains cannot be read.
    """
    from mimopilot.sitl.field.report.flight_report import make_report

    paths = [Path(one) for one in ([logs] if isinstance(logs, str | Path) else logs)]
    given: Sequence[GainSet] = [gains] if isinstance(gains, str | Path) or not isinstance(gains, Sequence) else gains
    named = [(_gains_name(one, place, len(given)), _gains(one)) for place, one in enumerate(given)]
    found = make_report(paths, named, _spec(spec, {}), _columns(columns))
    found.write(Path(out), None if figures is None else Path(figures))
    return found


def _gains_name(gains: GainSet, place: int, count: int) -> str:
    """Name of a gain set in a report: that of its file, else new."""
    if isinstance(gains, str | Path):
        from mimopilot.tuning.gains_file import set_name

        return set_name(Path(gains))
    return "new" if count == 1 else f"new {place + 1}"


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


def import_params(
    source: PathLike | None = None,
    *,
    connect: str | None = None,
    defaults: str | None = None,
    rate: float | None = None,
    profile: str = "mimo",
    airframe: PathLike | Airframe | None = None,
    timeout: float = 12.0,
    signing_key: PathLike | None = None,
    system: int = 0,
) -> ImportedGains:
    """Make gains from those of a vehicle's stock controller, PX4's or ArduPilot's.

    Parameters
    ----------
    source : str or Path, optional
        Parameter file of QGroundControl, MAVProxy or Mission Planner, or a flight log (ULog, dataflash).
    connect : str, optional
        Vehicle to read from instead: ``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT`` or ``DEVICE,BAUD``.
    defaults : str, optional
        ``px4-v1.16``: that PX4's defaults for what the source lacks. None: then it is refused.
    rate : float, optional, Hz
        Control rate; by default that of the parameters.
    profile : str
        ``mimo``: gains for our module. ``px4-stock``, ``ardupilot-stock``: the set of that controller itself.
    airframe : str, Path or Airframe, optional
        Vehicle whose unit of torque the gains have. None: what the vehicle publishes, else not known.
    timeout, signing_key, system
        Of the link, as in `upload`.

    Returns
    -------
    ImportedGains
        `gains`, without a certificate; the parameters that they are made of (`used`), and what the stock controller
        does that they do not hold (`not_carried`).

    Raises
    ------
    Error
        When the source cannot be read, holds no complete gains of a multirotor, or a value is not possible.
    """
    from mimopilot.common.errors import Error
    from mimopilot.tuning.logs.imported_gains import import_gains, read_source

    if (source is None) == (connect is None):
        raise Error("give either a parameter file or flight log, or --connect to read from a vehicle")
    if source is not None:
        found = read_source(Path(source))
    else:
        from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
        from mimopilot.sitl.mavlink.ground_station.stock_parameters import read_stock_parameters

        key = Path(signing_key) if signing_key else None
        found = read_stock_parameters(LinkOptions(str(connect), system, timeout, key))
    body = load_airframe(airframe) if isinstance(airframe, str | Path) else airframe
    scale = body.moment_scale() if body else None
    return import_gains(found, defaults=defaults, rate=rate, moment_scale=scale, profile=profile)


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

    loaded, chosen = _gains(gains), find_target(target)
    warnings = [check_verdict(loaded, allow=uncertified), chosen.rate_warning(loaded), chosen.shaping_warning(loaded)]
    files = render(loaded, target, **options)
    written = write_tree(files, Path(out), force)
    return GeneratedTree(
        [Path(out) / name for name in files], [Path(out) / name for name in written], list(filter(None, warnings))
    )


def load_airframe(name_or_path: PathLike) -> Airframe:
    """Load an airframe.

    Parameters
    ----------
    name_or_path : str or Path
        Name of an airframe that comes with mimopilot, or a TOML file.

    Returns
    -------
    Airframe

    Raises
    ------
    Error
        When the name is unknown, or the vehicle cannot fly.
    """
    from mimopilot.sitl.physics.airframe import load_airframe as load

    return load(str(name_or_path)).airframe


def fly(
    airframe: PathLike | Airframe,
    gains: GainSet | None = None,
    scenario: PathLike | Scenario = "doublet",
    *,
    axis: str | None = None,
    amplitude_deg: float | None = None,
    period_s: float | None = None,
    tail_s: float | None = None,
    faults: Iterable[str] = (),
    seed: int = 0,
    noise: bool = True,
    on: Literal["native", "cortex-m4"] = "native",
) -> Flight:
    """Fly the generated C++ in process.

    Parameters
    ----------
    airframe : str, Path or Airframe
        Name, TOML file, or an airframe.
    gains : str, Path or Gains, optional
        By default the airframe's own.
    scenario : str, Path or Scenario
        ``doublet``, ``step``, ``hover``, a scenario file (TOML), or a scenario.
    axis : str, optional
        ``roll`` (the default) or ``pitch``.
    amplitude_deg, period_s, tail_s : float, optional
        Of the manoeuvre; 22.5 degrees, 0.42 s and 1.5 s by default.
    faults : iterable of str
        ``KIND[:TARGET][=SIZE]@AT[+DURATION]``.
    seed : int
        Of the measurement noise.
    noise : bool
        False: exact measurements.
    on : str
        ``native``, or ``cortex-m4``: the vehicle's processor, emulated.

    Returns
    -------
    Flight
        See `performance` for its figures and `plot_flight`.

    Raises
    ------
    Error
        When the airframe, the gains, the scenario or a fault is not possible.
    """
    from mimopilot.sitl.autopilot.autopilot import Autopilot
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.flight.scenario import Scenario, scenario_of
    from mimopilot.sitl.flight.simulator import fly as fly_scenario

    check_choice("on", on, ("native", "cortex-m4"), SitlError)
    body, controller = vehicle(airframe, gains)
    task = (
        scenario
        if isinstance(scenario, Scenario)
        else scenario_of(str(scenario), axis, amplitude_deg, period_s, tail_s, list(faults), controller.Ts)
    )
    processor = None
    if on == "cortex-m4":
        from mimopilot.codegen.cortex_m4 import load_emulated

        processor = load_emulated(controller)
    return fly_scenario(body, Autopilot(body, controller, processor), task, seed, noise)


def performance(flight: Flight, gains: GainSet) -> Performance:
    """Figures of a flight over its manoeuvre, against the reference models of the gains.

    Parameters
    ----------
    flight : Flight
    gains : str, Path or Gains

    Returns
    -------
    Performance
        J_M and J_r of (6.1)-(6.4), peaks, off-axis RMS, effort; units in the names of its attributes.

    Raises
    ------
    Error
        When the gains cannot be read.
    """
    from mimopilot.sitl.flight.metrics import performance as figures

    return figures(flight, *_gains(gains).reference_models(flight.scenario.axis))


@reproducible
def experiment(
    airframe: PathLike | Airframe,
    out: PathLike | None = None,
    *,
    gains: GainSet | None = None,
    seconds_per_axis: float = 20.0,
    amplitude: float | None = None,
    bandwidth: float = 50.0,
    seed: int = 0,
    excitation_seed: int | None = None,
    both_axes: bool = False,
    axis: str = "all",
    yaw_amplitude: float | None = None,
) -> Experiment:
    """Fly a simulated experiment with a PRBS added to the torque on roll, then on pitch, then on yaw.

    Parameters
    ----------
    airframe, gains
        As in `fly`.
    out : str or Path, optional
        Where its log is written (ULog).
    seconds_per_axis : float, s
    amplitude : float, optional
        Of the injected torque (normalised); by default 0.15, or less if the motors would saturate.
    bandwidth : float, rad/s
        Of the injected torque.
    seed : int
        Of the measurement noise, and of the excitation where `excitation_seed` is not given.
    excitation_seed : int, optional
        Of the excitation.
    both_axes : bool
        Excite roll and pitch at once, for `seconds_per_axis`.
    axis : str
        ``all``, ``both`` (roll, then pitch), ``roll``, ``pitch`` or ``yaw``.
    yaw_amplitude : float, optional
        On yaw; by default 0.3, or less if the motors would saturate.

    Returns
    -------
    Experiment
        As read from the log.

    Raises
    ------
    Error
        When the airframe or the excitation is not possible, or the vehicle is lost.
    """
    from mimopilot.sitl.flight.excitation_flight import ExperimentPlan, check_survived, default_amplitude
    from mimopilot.tuning.logs.reader import read_log as read

    body, controller = vehicle(airframe, gains)
    strength = default_amplitude(body) if amplitude is None else amplitude
    plan = ExperimentPlan(
        body, controller, seconds_per_axis, strength, bandwidth, excitation_seed, both_axes, axis, yaw_amplitude
    )
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "flight.ulg" if out is None else Path(out)
        check_survived(plan.record(path, seed))
        return read(path)


def upload(
    gains: GainSet,
    connect: str,
    *,
    profile: str = "mimo",
    moment_scale: Triple | Literal["flown"] | None = None,
    dry_run: bool = False,
    force_armed: bool = False,
    uncertified: bool = False,
    timeout: float = 12.0,
    snapshot: PathLike | None = None,
    signing_key: PathLike | None = None,
    system: int = 0,
) -> UploadOutcome:
    """Upload all gains and verify each; after a failure restore the old values.

    Parameters
    ----------
    gains : str, Path or Gains
    connect : str
        ``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT`` or ``DEVICE,BAUD``; of a Crazyflie
        ``radio://0/80/2M`` or ``usb://0``.
    profile : str
        Controller that the gains are for: ``mimo``, our module, ``ardupilot-custom``, our custom controller in
        ArduCopter, ``px4-stock`` or ``ardupilot-stock``.
    moment_scale : tuple of 3 float (N m), or ``flown``, optional
        Unit of torque of a vehicle that does not publish it.
    dry_run, force_armed, uncertified : bool
        As the command's options.
    timeout : float, s
        Abort after this many seconds without a message.
    snapshot : str or Path, optional
        Where the old values are saved; by default a new file in the working folder, or beside the gains file.
    signing_key : str or Path, optional
        Sign with this key.
    system : int
        The vehicle's system number; 0: the only one there is.

    Returns
    -------
    UploadOutcome
        ``verified`` when every value was read back.

    Raises
    ------
    Error
        When the vehicle is not the one that the plan is for, or anything fails: the old values are restored.
    """
    from mimopilot.sitl.mavlink.ground_station.transaction import upload_and_verify

    plan, options, loaded, _ = prepare_upload(
        gains,
        connect,
        profile=profile,
        uncertified=uncertified,
        system=system,
        timeout=timeout,
        signing_key=Path(signing_key) if signing_key else None,
        force_armed=force_armed,
        dry_run=dry_run,
        yes=True,
        snapshot=Path(snapshot) if snapshot else None,
    )
    done = upload_and_verify(plan, options, loaded, moment_scale)
    done.check()
    return done.outcome


def autotune(
    connect: str,
    out: PathLike,
    *,
    profile: str = "mimo",
    take_off: float | None = None,
    arm: bool = False,
    seconds_per_axis: float = 20.0,
    amplitude: float | None = None,
    dialogue: AutotuneDialogue | None = None,
    timeout: float = 12.0,
    signing_key: PathLike | None = None,
    system: int = 0,
) -> Decisions:
    """Tune a vehicle in the field: experiment, gains, check flight; keep the new gains, or go back to the old ones.

    Parameters
    ----------
    connect, timeout, signing_key, system
        As in `upload`.
    out : str or Path
        Folder of logs, gains, decisions and report; after an interruption the same one goes on.
    profile : str
        ``mimo``: our module. ``px4-stock``, ``ardupilot-stock``: the autopilot's own controllers.
    take_off : float, optional, m
        Arm, take off to this height, and land. None: a pilot does that.
    arm : bool
        Arm a vehicle that does not say that it is simulated.
    seconds_per_axis, amplitude
        Of the excitation, as the command's options.
    dialogue : AutotuneDialogue, optional
        What is told and asked. None: nothing; every answer is yes.

    Returns
    -------
    Decisions
        What was done, when the new gains were kept.

    Raises
    ------
    Error
        When they were not: the message says why, and which gains the vehicle holds.
    """
    from mimopilot.sitl.field.autotune_console import SilentAnswers
    from mimopilot.sitl.field.autotune_run import AutotuneOptions
    from mimopilot.sitl.field.workflow import autotune as run

    options = AutotuneOptions(
        connect,
        Path(out),
        profile=profile,
        take_off=take_off,
        yes=dialogue is None,
        arm=arm,
        seconds_per_axis=seconds_per_axis,
        amplitude=amplitude,
        system=system,
        timeout=timeout,
        signing_key=Path(signing_key) if signing_key else None,
    )
    return run(options, dialogue or SilentAnswers())


def list_logs(
    connect: str,
    *,
    protocol: str = "auto",
    timeout: float = 12.0,
    signing_key: PathLike | None = None,
    system: int = 0,
) -> list[VehicleLog]:
    """Logs on a vehicle.

    Parameters
    ----------
    connect, timeout, signing_key, system
        As in `upload`.
    protocol : str
        ``ftp``, ``log`` (LOG_REQUEST_LIST), or ``auto``: FTP where the vehicle has it.

    Returns
    -------
    list of VehicleLog
        Name, size (bytes) and, if the vehicle reports it, time (s since 1970) of each.

    Raises
    ------
    Error
        When there is no vehicle, or it does not list logs.
    """
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.mavlink.log_transfer.log_session import list_logs as find

    return find(LinkOptions(connect, system, timeout, Path(signing_key) if signing_key else None), protocol)


def download_log(
    connect: str,
    out: PathLike = ".",
    *,
    name: str | None = None,
    protocol: str = "auto",
    timeout: float = 12.0,
    signing_key: PathLike | None = None,
    system: int = 0,
) -> Download:
    """Download a log of a vehicle, or what an earlier download has left of it, and verify it.

    Parameters
    ----------
    connect, protocol, timeout, signing_key, system
        As in `list_logs`.
    out : str or Path
        Folder of the log.
    name : str, optional
        Of the log; by default the last one.

    Returns
    -------
    Download
        Its `path`, and whether it was `verified` by its CRC-32 or its size.

    Raises
    ------
    Error
        When the log cannot be read or verified, is being written, or another file has its name; a part is kept.
    """
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.mavlink.log_transfer.log_session import download_log as download

    options = LinkOptions(connect, system, timeout, Path(signing_key) if signing_key else None)
    return download(options, name, Path(out), protocol)


def prepare_upload(
    gains: GainSet, connect: str, *, profile: str, uncertified: bool, **link: Any
) -> tuple[UploadPlan, LinkOptions, Gains, str]:
    """Plan of an upload, the options of its link, the gains, and a warning about their stability; see `upload`."""
    from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.tuning.acceptance import check_verdict
    from mimopilot.tuning.gains_file import set_name

    loaded = _gains(gains)
    warning = check_verdict(loaded, allow=uncertified)
    source = Path(gains) if isinstance(gains, str | Path) else Path("gains")
    stem = source.with_name(set_name(source))
    plan = make_plan(loaded, profile)
    return plan, LinkOptions(connect, stem=stem, **link), loaded, warning


def vehicle(airframe: PathLike | Airframe, gains: GainSet | None = None) -> tuple[Airframe, Gains]:
    """An airframe and the gains that fly it, by default its own."""
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.physics.airframe import load_airframe as load

    if not isinstance(airframe, str | Path):
        if gains is None:
            raise SitlError(f"gains: an airframe that is no file ({airframe.name}) has none of its own; give them")
        return airframe, _gains(gains)
    loaded = load(str(airframe))
    return loaded.airframe, loaded.default_gains() if gains is None else _gains(gains)


def _experiment(log: Log, columns: PathLike | None) -> Experiment:
    from mimopilot.tuning.logs.reader import read_log as read

    return read(Path(log), _columns(columns)) if isinstance(log, str | Path) else log


def _gains(gains: GainSet) -> Gains:
    return load_gains(gains) if isinstance(gains, str | Path) else gains


def _columns(path: PathLike | None) -> Columns | None:
    from mimopilot.tuning.logs.columns import load_columns

    return None if path is None else load_columns(Path(path))


def _spec(spec: PathLike | TuningSpec | None, overrides: Mapping[str, Any]) -> TuningSpec:
    from mimopilot.tuning.spec import load_spec

    given = {name: value for name, value in overrides.items() if value is not None}
    if spec is None or isinstance(spec, str | Path):
        return load_spec(None if spec is None else Path(spec), **given)
    return load_spec(None, **{**{name: getattr(spec, name) for name in spec.model_fields_set}, **given})
