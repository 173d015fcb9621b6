"""Lists and downloads over a simulated link: byte-exact under loss, resumed, and clear about what fails."""

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import run_exchange
from mimopilot.sitl.mavlink.log_transfer import part_file
from mimopilot.sitl.mavlink.log_transfer.transfer_client import TransferClient
from mimopilot.sitl.mavlink.log_transfer.vehicle_logs import VehicleLogs
from tests.sitl.mavlink.log_transfer.logging_vehicle import ARDUPILOT, PX4, OwnVehicle, ScriptedLogs, content
from tests.sitl.mavlink.scripted_vehicle import SimulatedLink

SIZE = 150_001
DATED = {
    "2026-11-28/10_00_00.ulg": content(3000, 2),
    "2026-11-29/09_30_00.ulg": content(SIZE, 3),
    "2026-11-29/9_00_00.ulg": content(10, 4),
}
NEWEST = "2026-11-29/09_30_00.ulg"


class Run:
    """A ground station on a simulated link to a vehicle."""

    def __init__(self, vehicle, **link):
        self.link = SimulatedLink(vehicle, **link)
        vehicle.now = self.link.now
        self.client = TransferClient(self.link.now())
        self.logs = VehicleLogs(self.client)

    def __call__(self, exchange):
        return run_exchange(exchange, self.link)

    def find(self, protocol="auto"):
        return self(self.logs.find(protocol))

    def download(self, folder, name=None, protocol="auto"):
        if not self.logs.logs:
            self.find(protocol)
        return self(self.logs.download(self(self.logs.choose(name)), folder))


def stop_at(run, share):
    """Ctrl-C when a share has arrived."""

    def progress(phase, done, of):
        run.client.interrupted |= phase == "downloading" and done >= share * of

    run.client.progress = progress


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("protocol", ["ftp", "log"])
@pytest.mark.parametrize("vehicle", ["own", "px4", "ardupilot"])
def test_a_log_arrives_byte_for_byte_at_30_percent_loss_each_way(vehicle, protocol, loss, tmp_path):
    disturbed = {"loss": loss, "duplicate": 0.1, "reorder": 0.1} if loss else {}
    names = {f"{n:08d}.BIN": content(500 + n) for n in range(1, 6)} | {"00000006.BIN": content(SIZE, 7)}
    peer = {
        "own": lambda: OwnVehicle(tmp_path / "card", 700, SIZE),
        "px4": lambda: ScriptedLogs(DATED),
        "ardupilot": lambda: ScriptedLogs({**names, "LASTLOG.TXT": b"6\r\n"}, ARDUPILOT, folder="/APM/LOGS"),
    }[vehicle]()
    expected = {"own": content(SIZE, 1), "px4": DATED[NEWEST], "ardupilot": names["00000006.BIN"]}[vehicle]
    name = {("px4", "log"): "1", ("ardupilot", "log"): "6"}.get((vehicle, protocol))
    run = Run(peer, seed=5, **disturbed)
    done = run.download(tmp_path / "out", name, protocol)
    assert done.path.read_bytes() == expected
    assert (done.verified, done.written, done.resumed) == ("crc32" if protocol == "ftp" else "size", True, 0)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [done.path.name]
    # 629 pieces, or 1,667: a piece for each round trip of 0.1 s would take 63 or 167 s.
    assert run.link.time < (5 if not loss else 50)


def test_logs_are_listed_by_both_protocols_with_their_sizes(tmp_path):
    own = OwnVehicle(tmp_path, 700, 90, *[5] * 20)
    by_ftp, by_log = Run(own).find("ftp"), Run(own).find("log")
    assert [(log.name, log.size) for log in by_ftp][:2] == [("flight-1.ulg", 700), ("flight-2.ulg", 90)]
    assert [log.size for log in by_log] == [log.size for log in by_ftp] == [700, 90, *[5] * 20]
    assert (by_log[3].name, by_log[3].time, by_ftp[3].time) == ("3", 1_700_000_003, None)
    lossy = Run(ScriptedLogs(DATED), seed=2, loss=0.3)
    # 9 comes before 09 of the same value only by the text: both are compared as numbers first.
    assert sorted(log.name for log in lossy.find()) == sorted(DATED)
    assert lossy.logs.protocol == "ftp"


def test_the_last_log_is_that_of_the_newest_name_number_or_time(tmp_path):
    assert Run(ScriptedLogs(DATED)).download(tmp_path).path.name == "2026-11-29-09_30_00.ulg"
    sessions = {"sess9/log100.ulg": b"old", "sess10/log2.ulg": b"second", "sess10/log10.ulg": b"newest"}
    assert Run(ScriptedLogs(sessions)).download(tmp_path).path.read_bytes() == b"newest"
    # The numbers began again: LASTLOG.TXT says where.
    wrapped = {"00000002.BIN": b"newest", "00000500.BIN": b"old", "LASTLOG.TXT": b"2\r\n"}
    run = Run(ScriptedLogs(wrapped, ARDUPILOT, folder="/APM/LOGS"))
    assert run.download(tmp_path).path.read_bytes() == b"newest"
    with pytest.raises(SitlError, match=r"which log is the last: 2026-\S+ has a date, sess10/log10.ulg has none"):
        Run(ScriptedLogs(DATED | sessions)).download(tmp_path)
    # By the log protocol: the latest time on PX4, whose numbers follow the card; the highest number on ArduPilot.
    assert Run(ScriptedLogs(sessions, PX4)).download(tmp_path, protocol="log").path.read_bytes() == b"old"
    run = Run(ScriptedLogs({"1.BIN": b"old", "2.BIN": b"new"}, ARDUPILOT))
    assert run.download(tmp_path, protocol="log").path.name == "log002-2023-11-14-22_13_18.bin"


def test_a_log_is_named_by_the_end_of_its_path(tmp_path):
    run = Run(ScriptedLogs({**DATED, "2026-11-28/09_30_00.ulg": b"x"}))
    run.find()
    assert run(run.logs.choose("10_00_00.ulg")).name == "2026-11-28/10_00_00.ulg"
    with pytest.raises(SitlError, match=r"several logs have this name: 2026-11-28\S+, 2026-11-29/09"):
        run(run.logs.choose("09_30_00.ulg"))
    with pytest.raises(SitlError, match="there is no such log"):
        run(run.logs.choose("00_00.ulg"))


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("protocol", ["ftp", "log"])
def test_a_download_that_is_interrupted_three_times_goes_on_where_it_was(protocol, loss, tmp_path):
    vehicle = OwnVehicle(tmp_path / "card", SIZE)
    for share in (0.2, 0.5, 0.9):
        run = Run(vehicle, seed=3, loss=loss)
        stop_at(run, share)
        with pytest.raises(SitlError, match=r"interrupted; \S+\.part holds \d+ of 150001 bytes: give") as e:
            run.download(tmp_path / "out", protocol=protocol)
        assert e.value.exit_code == 1
        assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [".json", ".part"]
    run = Run(vehicle, seed=4, loss=loss)
    done = run.download(tmp_path / "out", protocol=protocol)
    assert done.path.read_bytes() == content(SIZE, 0)
    assert 0.9 * SIZE <= done.resumed <= SIZE
    assert list((tmp_path / "out").iterdir()) == [done.path]


def test_a_lost_link_keeps_the_part(tmp_path):
    vehicle = ScriptedLogs(DATED)
    for message in ("no message from the vehicle for 12 s", "the link was lost"):
        vehicle.fault = ""
        run = Run(vehicle)

        def lose(phase, done, of, run=run, message=message):
            if phase == "downloading" and done > 0.1 * of:
                run.link.closed = message == "the link was lost"
                vehicle.fault = "gone"

        run.client.progress = lose
        with pytest.raises(SitlError, match=rf"{message}; \S+\.part holds"):
            run.download(tmp_path)
    vehicle.fault = ""
    done = Run(vehicle).download(tmp_path)
    assert done.resumed > 30_000
    assert done.path.read_bytes() == DATED[NEWEST]


@pytest.mark.parametrize("protocol", ["ftp", "log"])
def test_a_pause_of_the_link_shorter_than_the_timeout_is_survived(protocol, tmp_path):
    class Pausing(SimulatedLink):
        up = property(lambda self: not 0.9 < self.time - begun[0] < 11.9, lambda self, value: None)

    vehicle, begun = ScriptedLogs(DATED), [1e9]
    run = Run(vehicle)
    run.link.__class__ = Pausing
    run.find(protocol)
    begun[0] = run.link.time - 0.5  # 0.4 s of data
    done = run.download(tmp_path, "1" if protocol == "log" else NEWEST, protocol)
    assert done.path.read_bytes() == DATED[NEWEST]
    assert 11.4 < run.link.time < 20.0


def test_the_same_file_is_not_downloaded_again_and_another_one_is_not_replaced(tmp_path):
    vehicle = ScriptedLogs(DATED)
    for protocol, name in (("ftp", NEWEST), ("log", "1")):
        first = Run(vehicle).download(tmp_path, name, protocol)
        vehicle.counts.clear()
        second = Run(vehicle).download(tmp_path, name, protocol)
        assert (second.path, second.written, first.written) == (first.path, False, True)
        assert vehicle.counts.get(15, 0) == 0  # no burst: the checksums were compared
        for other in (b"mine", b"\0" * SIZE):
            first.path.write_bytes(other)
            with pytest.raises(SitlError, match="exists and has another content than the vehicle's log") as e:
                Run(vehicle).download(tmp_path, name, protocol)
            assert e.value.exit_code == 2
            assert first.path.read_bytes() == other


FAULTS = {
    "neither": "no logs from the vehicle, a quadrotor with PX4: it does not answer FTP; it does not answer LOG_REQ",
    "unreadable card": r"cannot read /logs: error 5 \(Input/output error\); it does not answer LOG_REQUEST_LIST",
    "bad sector": r"it: error 5 \(Input/output error\); \S+\.part holds \d+ of 150001 bytes: give the same command",
    "grows": r"has 150005 bytes now, and had 150001: the vehicle is still writing it; disarm it, or stop its logger",
    "wrong checksum": r"its checksum is not the vehicle's, so it was removed; give the same command again",
    "mute": r"does not answer FTP; it does not answer LOG_REQUEST_LIST \(no logs, no card, or logging is off\)",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_the_vehicle_are_said(fault, tmp_path):
    vehicle = ScriptedLogs(DATED, fault=fault)
    vehicle.files = {} if fault in ("mute", "unreadable card") else vehicle.files
    with pytest.raises(SitlError, match=FAULTS[fault]) as error:
        Run(vehicle).download(tmp_path)
    assert error.value.exit_code == 1
    # Nothing stays of what is wrong or empty.
    assert len(list(tmp_path.iterdir())) == (2 if fault == "bad sector" else 0)


def test_faults_of_a_vehicle_without_ftp_are_said(tmp_path):
    without = {name: data for name, data in DATED.items() if name == NEWEST}
    for fault, message in {
        "bad sector": r"log 0: the vehicle can read only 74970 of 150001 bytes; \S+\.part holds 74970 of 150001 bytes",
        "grows": "0: has 15[0-9]+ bytes now, and had 150001: the vehicle is still writing it",
    }.items():
        vehicle = ScriptedLogs(without, fault=fault)
        vehicle.ftp = lambda packet: [packet.refuse(7)]
        with pytest.raises(SitlError, match=message):
            Run(vehicle).download(tmp_path / fault.replace(" ", "-"))


def test_without_ftp_the_log_protocol_is_used(tmp_path):
    for fault in ("no ftp", "nak"):
        run = Run(ScriptedLogs(DATED, fault=fault))
        done = run.download(tmp_path / fault, "1")
        assert (done.protocol, done.path.read_bytes()) == ("log", DATED[NEWEST])
        assert run.link.time < 12.0
    with pytest.raises(SitlError, match="it has no FTP"):
        Run(ScriptedLogs(DATED, fault="nak")).find("ftp")


def test_a_log_that_has_grown_is_completed_once_it_is_closed(tmp_path):
    vehicle = ScriptedLogs(DATED, fault="grows late")
    with pytest.raises(SitlError, match="has 150005 bytes now, and had 150001: the vehicle is still writing it"):
        Run(vehicle).download(tmp_path)
    vehicle.fault = ""
    done = Run(vehicle).download(tmp_path)
    assert (done.resumed, done.verified) == (SIZE, "crc32")
    assert done.path.read_bytes() == DATED[NEWEST] + b"more"


def test_an_armed_vehicle_is_refused_and_arming_stops_a_download(tmp_path):
    vehicle = ScriptedLogs(DATED)
    vehicle.armed = True
    run = Run(vehicle)
    assert len(run.find()) == 3
    with pytest.raises(SitlError, match="the vehicle is armed: its last log is being written"):
        run.download(tmp_path)
    with pytest.raises(SitlError, match="it is armed: ArduPilot lists its logs only when disarmed"):
        Run(_armed(ScriptedLogs(DATED, ARDUPILOT, fault="no ftp"))).find()
    vehicle.armed = False
    run = Run(ScriptedLogs({"a.ulg": content(4_000_000)}), latency=0.5)
    run.client.progress = lambda phase, done, of: setattr(run.link.vehicles["", 0], "armed", phase == "downloading")
    with pytest.raises(SitlError, match=r"the vehicle was armed: its link is needed for the flight; a\.ulg\.part"):
        run.download(tmp_path)


def _armed(vehicle):
    vehicle.armed = True
    return vehicle


def test_a_vehicle_without_logs_or_with_an_empty_one_is_said(tmp_path):
    for vehicle in (OwnVehicle(tmp_path), ScriptedLogs({})):
        run = Run(vehicle)
        assert run.find() == []
        with pytest.raises(SitlError, match="the vehicle has no logs"):
            run(run.logs.choose(None))
    assert Run(OwnVehicle(tmp_path)).find("log") == []
    with pytest.raises(SitlError, match=r"a\.ulg: has 0 bytes"):
        Run(ScriptedLogs({"a.ulg": b""})).download(tmp_path)


def test_bursts_and_checksums_are_not_needed(tmp_path):
    done = Run(ScriptedLogs({"a.ulg": content(9000)}, fault="no bursts"), loss=0.3, seed=1).download(tmp_path)
    assert (done.path.read_bytes(), done.verified) == (content(9000), "crc32")
    done = Run(ScriptedLogs({"b.ulg": content(9000)}, fault="no checksum")).download(tmp_path)
    assert (done.path.read_bytes(), done.verified) == (content(9000), "size")


def test_a_session_left_open_and_one_that_closes_by_itself_are_opened_again(tmp_path):
    vehicle = ScriptedLogs(DATED)
    vehicle.open = f"{vehicle.folder}/{NEWEST}"  # of a download that was killed
    run = Run(vehicle)
    closed = []

    def progress(phase, done, of):
        if phase == "downloading" and done > 0.4 * of and not closed:
            closed.append(done)
            vehicle.open = None

    run.client.progress = progress
    assert run.download(tmp_path).path.read_bytes() == DATED[NEWEST]
    assert closed
    assert vehicle.counts[4] == 3  # refused, opened, opened again


def test_a_slow_burst_of_one_file_is_not_taken_for_another(tmp_path):
    """Pieces of an interrupted download arrive while the next one runs; PX4's session is always 0."""
    vehicle = ScriptedLogs(DATED | {"2026-11-30/00_00_00.ulg": content(SIZE, 9)})
    real, late = vehicle.burst, []

    def burst(packet):
        stale = packet._replace(sequence=(packet.sequence + 777) % 65536)
        wrong = [p._replace(data=bytes(len(p.data))) for p in real(stale) if p.opcode == 128]
        late.append(len(wrong))
        return [*wrong, *real(packet)]

    vehicle.burst = burst
    assert Run(vehicle).download(tmp_path).path.read_bytes() == content(SIZE, 9)
    assert sum(late) > 600


def test_a_full_disk_keeps_the_part_and_says_so(tmp_path, monkeypatch):
    vehicle = ScriptedLogs(DATED)
    free = part_file.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(part_file.shutil, "disk_usage", lambda path: free._replace(free=SIZE - 1))
    with pytest.raises(SitlError, match=r"0\.1 MB are free, the log needs 0\.2 MB more") as error:
        Run(vehicle).download(tmp_path)
    assert error.value.exit_code == 1
    monkeypatch.undo()
    real, left = part_file.os.pwrite, [60_000]

    def pwrite(file, data, offset):
        left[0] -= len(data)
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        return real(file, data, offset)

    monkeypatch.setattr(part_file.os, "pwrite", pwrite)
    with pytest.raises(SitlError, match=r"cannot be written: No space left on device; \S+\.part holds 59989 of 150001"):
        Run(vehicle).download(tmp_path)
    monkeypatch.undo()
    done = Run(vehicle).download(tmp_path)
    assert (done.resumed, done.path.read_bytes()) == (59_989, DATED[NEWEST])


def test_a_name_from_the_vehicle_cannot_leave_the_folder(tmp_path):
    for name in ("..\\..\\x/a\n.ulg", "../../x.ulg", "./.ulg"):
        vehicle = ScriptedLogs({"d/a.ulg": b"12"})
        run = Run(vehicle)
        (log,) = run.find()
        path = run(run.logs.download(log.__class__(name, 2, None, log.path), tmp_path / "out")).path
        assert path.parent == tmp_path / "out"
        assert path.name.isascii()
        assert not path.name.startswith(".")
        path.unlink()
