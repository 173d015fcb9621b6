"""With a vehicle: its parameters, upload, autotune, its logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mimopilot.api.arguments import given_gains
from mimopilot.api.bench import load_airframe

if TYPE_CHECKING:
    from mimopilot.api.arguments import GainSet, PathLike
    from mimopilot.sitl.field.autotune_run import AutotuneDialogue
    from mimopilot.sitl.field.decisions import Decisions
    from mimopilot.sitl.mavlink.ground_station.profiles import UploadPlan
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.mavlink.ground_station.upload import UploadOutcome
    from mimopilot.sitl.mavlink.log_transfer.vehicle_logs import Download, VehicleLog
    from mimopilot.sitl.physics.airframe import Airframe
    from mimopilot.tuning.gains import Gains, Triple
    from mimopilot.tuning.logs.imported_gains import ImportedGains


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

    loaded = given_gains(gains)
    warning = check_verdict(loaded, allow=uncertified)
    source = Path(gains) if isinstance(gains, str | Path) else Path("gains")
    stem = source.with_name(set_name(source))
    plan = make_plan(loaded, profile)
    return plan, LinkOptions(connect, stem=stem, **link), loaded, warning
