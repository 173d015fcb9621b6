"""Commands on a vehicle's parameters and logs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mimopilot.cli.options import (
    GainsArgument,
    JsonOption,
    KeyOption,
    SystemOption,
    TimeoutOption,
    UncertifiedOption,
    YesOption,
)
from mimopilot.common.verbosity import warn

if TYPE_CHECKING:
    from mimopilot.tuning.logs.imported_gains import ImportedGains

ConnectOption = Annotated[
    str,
    typer.Option(
        "--connect",
        help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/ttyACM0,57600; for upload, restore and params "
        "also a Crazyflie's radio://0/80/2M or usb://0.",
    ),
]
CONTROLLERS = (
    "Controller: mimo (our module), ardupilot-custom (our custom controller in ArduCopter), px4-stock or "
    "ardupilot-stock (the autopilot's own)."
)
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Only read and compare.")]
ForceArmedOption = Annotated[
    bool, typer.Option("--force-armed", help="Write even to a vehicle that is or becomes armed.")
]
SnapshotOption = Annotated[
    Path | None,
    typer.Option(dir_okay=False, help="Where the old values go; by default a new file beside the other one."),
]


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot upload my.gains.toml --connect udpin:127.0.0.1:14550")(upload)
    app.command(epilog="Example: mimopilot restore my.before-1.params --connect /dev/ttyACM0,57600")(restore)
    app.command(epilog="Example: mimopilot params my.gains.toml --format qgc --out my.params")(params)
    app.command(epilog="Example: mimopilot logs --connect udpin:0.0.0.0:14550 --last --out logs")(logs)
    app.command(
        epilog="Example: mimopilot import-params vehicle.params --out first.gains.toml; "
        "mimopilot import-params --connect udpin:0.0.0.0:14550 --out first.gains.toml"
    )(import_params)


def upload(
    gains: GainsArgument,
    connect: ConnectOption,
    profile: Annotated[str | None, typer.Option(help=CONTROLLERS, show_default="mimo")] = None,
    moment_scale: Annotated[
        str | None,
        typer.Option(
            help="N m of u = 1 on a vehicle that does not publish it: ROLL,PITCH,YAW; or flown: "
            "the gains come from a log of this very vehicle and allocator."
        ),
    ] = None,
    dry_run: DryRunOption = False,
    yes: YesOption = False,
    force_armed: ForceArmedOption = False,
    uncertified: UncertifiedOption = False,
    timeout: TimeoutOption = 12.0,
    snapshot: SnapshotOption = None,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Upload all gains and verify each; after a failure restore the old values.

    Nothing is written to an armed vehicle, or after a HEARTBEAT older than 1.5 s: a new one is requested. Once the
    vehicle has stored its values, 2.5 s after the last write and after another HEARTBEAT, all of them are read again.
    After any failure until then (Ctrl-C, arming, a value refused, changed or contradicted, a second vehicle with the
    same system number) the old values are restored, also on an armed vehicle, and the exit code is 1. If the link is
    lost, every parameter that may hold a new value is listed.
    """
    from mimopilot.api.vehicle import prepare_upload
    from mimopilot.sitl.mavlink.ground_station.upload_console import parse_scale, upload_with_dialogue

    plan, options, loaded, doubt = prepare_upload(
        gains,
        connect,
        profile=profile or "mimo",
        uncertified=uncertified,
        system=system,
        timeout=timeout,
        signing_key=signing_key,
        force_armed=force_armed,
        dry_run=dry_run,
        yes=yes,
        as_json=as_json,
        snapshot=snapshot,
    )
    warn(gains, [doubt] if doubt else [])
    upload_with_dialogue(plan, options, loaded, parse_scale(moment_scale))


def restore(
    parameters: Annotated[Path, typer.Argument(help="Snapshot of an upload, or any parameter file of floats.")],
    connect: ConnectOption,
    dry_run: DryRunOption = False,
    yes: YesOption = False,
    force_armed: ForceArmedOption = False,
    timeout: TimeoutOption = 12.0,
    snapshot: SnapshotOption = None,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Restore a snapshot, with the checks of an upload.

    A snapshot that is not whole, holds a part of our gains only, or a value out of its range, is refused.
    """
    from mimopilot.sitl.mavlink.ground_station.profiles import make_restore_plan
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.mavlink.ground_station.upload_console import upload_with_dialogue
    from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters

    plan = make_restore_plan(read_parameters(parameters), str(parameters))
    stem = parameters.with_name(
        re.sub(r"(\.before-\d+)?\.\w+$", "", parameters.name)
    )  # the next snapshot gets the next number
    options = LinkOptions(
        connect,
        system,
        timeout,
        signing_key,
        force_armed=force_armed,
        dry_run=dry_run,
        yes=yes,
        as_json=as_json,
        snapshot=snapshot,
        stem=stem,
    )
    upload_with_dialogue(plan, options)


def params(
    gains: Annotated[Path | None, typer.Argument(help="Gains file: FILE.gains.toml.")] = None,
    connect: Annotated[str | None, typer.Option(help="Vehicle to read from; see upload.")] = None,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help="qgc, mavproxy, missionplanner; for a gains file also c-header, px4-yaml, betaflight (its CLI).",
        ),
    ] = "qgc",
    profile: Annotated[str | None, typer.Option(help=CONTROLLERS, show_default="that of the gains, else mimo")] = None,
    out: Annotated[Path | None, typer.Option(dir_okay=False, help="File to write; by default standard output.")] = None,
    uncertified: UncertifiedOption = False,
    timeout: TimeoutOption = 12.0,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Write gains, or what a vehicle holds, as a parameter file; compare the two when both are given."""
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.mavlink.ground_station.params_console import compare, export
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions

    options = LinkOptions(connect or "", system, timeout, signing_key, as_json=as_json)
    if gains is None or connect is None:
        if as_json:
            raise SitlError("--json: belongs to the comparison of a gains file with a vehicle")
        export(gains, options, form, out, uncertified, profile)
    elif out is not None:
        raise SitlError("--out: a comparison is printed; give either a gains file or --connect to write a file")
    else:
        compare(gains, options, profile)


def logs(
    connect: ConnectOption,
    name: Annotated[str | None, typer.Argument(metavar="[LOG]", help="Log to download, by its listed name.")] = None,
    last: Annotated[bool, typer.Option("--last", help="Download the last log.")] = False,
    out: Annotated[Path, typer.Option(file_okay=False, help="Folder of the downloaded log.")] = Path(),
    protocol: Annotated[
        str, typer.Option(help="ftp, log (LOG_REQUEST_LIST), or auto: FTP where the vehicle has it.")
    ] = "auto",
    timeout: TimeoutOption = 12.0,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """List the logs of a vehicle, or download one.

    An interrupted download (Ctrl-C, a lost link, a full disk) leaves LOG.part and LOG.part.json, and the same command
    goes on. The size, and by FTP the CRC-32, must be the vehicle's. An armed vehicle is refused.
    """
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.mavlink.log_transfer.logs_console import show_download, show_logs

    if last and name is not None:
        raise SitlError("--last: give either --last or the name of a log")
    options = LinkOptions(connect, system, timeout, signing_key, as_json=as_json)
    if last or name is not None:
        show_download(options, name, out, protocol)
    else:
        show_logs(options, protocol)


def import_params(
    source: Annotated[
        Path | None,
        typer.Argument(help="Parameter file (QGroundControl, MAVProxy, Mission Planner) or flight log (ULog, .bin)."),
    ] = None,
    connect: Annotated[str | None, typer.Option(help="Vehicle to read from; see upload.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            dir_okay=False, help="Gains file to write; by default a new one beside the source, NAME.gains.toml."
        ),
    ] = None,
    defaults: Annotated[
        str | None, typer.Option(help="px4-v1.16: its defaults for what the file lacks. Without it that is refused.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Control rate, Hz; by default IMU_GYRO_RATEMAX or SCHED_LOOP_RATE.")
    ] = None,
    profile: Annotated[
        str,
        typer.Option(
            help="mimo: for our module, to fly it with the gains of before. px4-stock, ardupilot-stock: the stock "
            "set itself."
        ),
    ] = "mimo",
    airframe: Annotated[
        str | None, typer.Option(help="Airframe whose unit of torque the gains have; by default it is unknown.")
    ] = None,
    timeout: TimeoutOption = 12.0,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Make a first gains file from a vehicle's stock gains.

    Of PX4 or ArduCopter. What a gains file cannot hold is listed; a parameter that is not found is no zero or default,
    the command then ends. The gains have no certificate.
    """
    import mimopilot as mp
    from mimopilot.common.console import print_json, print_text
    from mimopilot.tuning.errors import TuningError

    target = out or (source.with_suffix(".gains.toml") if source else Path("vehicle.gains.toml"))
    if out is None and target.exists():
        raise TuningError(f"{target}: exists; give --out to replace it or to write another file")
    found = mp.import_params(
        source,
        connect=connect,
        defaults=defaults,
        rate=rate,
        profile=profile,
        airframe=airframe,
        timeout=timeout,
        signing_key=signing_key,
        system=system,
    )
    found.gains.save(target)
    warn(source or str(connect), found.warnings)
    if as_json:
        origin = found.gains.provenance.details
        print_json(
            {
                "out": str(target),
                "source": origin["source"],
                "source_sha256": origin["source_sha256"],
                "parameters": found.used,
                "defaults": list(found.defaults),
                "controller": found.gains.controller,
                "Ts": found.gains.Ts,
                "elements": found.gains.for_our_law().elements(),
                "moment_scale": found.gains.moment_scale,
                "not_carried": list(found.not_carried),
                "warnings": list(found.warnings),
            }
        )
        return
    print_import(found)
    print_text(
        f"written to {target}; no certificate: fly an experiment with these gains, then mimopilot tune or certify"
    )


def print_import(found: ImportedGains) -> None:
    """Table of the parameters and the gains that they became, and what the gains do not hold."""
    from mimopilot.common.console import print_table, print_text
    from mimopilot.tuning.parameter_row import Shape
    from mimopilot.tuning.parameters import ROWS

    gains, rows = found.gains, []
    elements = gains.for_our_law().elements()
    for row in ROWS:
        for code in row.codes:
            names = found.stock.names(row, code)
            if names:
                given = " x ".join(f"{found.used[name]:g}" for name in names)
                value = row.value(elements[code], gains.Ts)
                unit = "Hz" if row.shape is Shape.POLE else row.unit.replace("norm", "")
                notes = "default" if any(name in found.defaults for name in names) else ""
                rows.append([" x ".join(names), given, f"{row.key} {code}", f"{value:.6g}", unit, notes])
    rate = found.stock.rate
    given = f"{found.used[rate]:g}" if rate in found.used else ""
    notes = ("default" if rate in found.defaults else "") if given else "--rate"
    rows.append([rate, given, "Ts", f"{gains.Ts:.6g}", "s", notes])
    print_table(f"Gains of {found.stock.name}", ["parameter", "value", "gain", "value", "unit", ""], rows)
    print_text("not in the gains file:")
    for text in found.not_carried:
        print_text(f"  {text}")
