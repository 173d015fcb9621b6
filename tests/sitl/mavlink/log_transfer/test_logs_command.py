"""The command `logs` and the API, against our vehicle's stations and log server on real sockets."""

import json
import signal
import subprocess
import threading
import time
from contextlib import contextmanager

import pytest

import mimopilot as mp
from mimopilot.sitl.mavlink.ground_station import vehicle_link_state
from mimopilot.sitl.mavlink.vehicle.stations import Stations
from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.log_transfer.logging_vehicle import OwnVehicle, content
from tests.sitl.mavlink.running import QUICK, wait_for
from tests.sitl.mavlink.scripted_vehicle import encode

SIZE = 400_000


@contextmanager
def serving(folder, *sizes, pause=0.0):
    """Our vehicle's log server on a UDP and a TCP port; `pause` (s) slows it down."""
    vehicle, stations, stop = OwnVehicle(folder, *sizes), Stations(9, 0), threading.Event()
    stations.subscribe("HEARTBEAT", *vehicle.server.handlers)

    def run():
        due = 0.0
        while not stop.is_set():
            for message, station in stations.receive():
                handler = vehicle.server.handlers.get(message.get_type())
                for answer in handler(message, station) if handler else ():
                    stations.post(answer, station)
            if time.monotonic() >= due:
                due = time.monotonic() + 0.1
                stations.send(encode(vehicle.heartbeat()[0]))
            stations.deliver()
            time.sleep(0.0005 + pause)

    thread = threading.Thread(target=run)
    thread.start()
    vehicle.tcp = f"tcp:127.0.0.1:{stations.tcp.getsockname()[1]}"
    vehicle.udp = f"udpout:127.0.0.1:{stations.udp.getsockname()[1]}"
    try:
        yield vehicle
    finally:
        stop.set()
        thread.join(timeout=10)
        stations.close()


def test_the_api_lists_and_downloads_over_udp_and_tcp(tmp_path, monkeypatch):
    monkeypatch.setattr(vehicle_link_state, "LISTEN_S", 0.15)
    with serving(tmp_path / "card", 1000, SIZE) as vehicle:
        for url in (vehicle.tcp, vehicle.udp):
            assert [(log.name, log.size) for log in mp.list_logs(url)] == [
                ("flight-1.ulg", 1000),
                ("flight-2.ulg", SIZE),
            ]
            for protocol in ("ftp", "log"):
                done = mp.download_log(url, tmp_path / f"{url[:3]}-{protocol}", protocol=protocol)
                assert done.path.read_bytes() == content(SIZE, 1)
        with pytest.raises(mp.Error, match="no such log"):
            mp.download_log(vehicle.tcp, tmp_path, name="flight-3.ulg")


def test_the_command_lists_downloads_and_refuses(mimopilot, tmp_path):
    with serving(tmp_path / "card", 1000, 20_000) as vehicle:
        listed = mimopilot("logs", "--connect", vehicle.tcp)
        assert "vehicle 1: 2 logs, by FTP" in listed.stdout
        assert "flight-2.ulg" in listed.stdout
        done = mimopilot("logs", "--connect", vehicle.tcp, "--last", "--out", "logs", "--json")
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert (found["path"], found["verified"], found["written"]) == ("logs/flight-2.ulg", "crc32", True)
        assert (tmp_path / "logs/flight-2.ulg").read_bytes() == content(20_000, 1)
        (tmp_path / "logs/flight-2.ulg").write_bytes(b"another")
        refused = mimopilot("logs", "flight-2.ulg", "--connect", vehicle.tcp, "--out", "logs")
        assert_one_clear_line(refused, "logs/flight-2.ulg: exists and has another content", "rename it")
        vehicle.armed = True
        refused = mimopilot("logs", "--connect", vehicle.tcp, "--last")
        assert_one_clear_line(refused, "the vehicle is armed", "land and disarm", code=1)


def test_ctrl_c_keeps_the_part_and_the_same_command_goes_on(tmp_path):
    with serving(tmp_path / "card", SIZE, pause=0.01) as vehicle:
        command = [*QUICK, "logs", "--connect", vehicle.tcp, "--last", "--out", tmp_path / "out"]
        part = tmp_path / "out" / "flight-1.ulg.part"
        running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
        wait_for(lambda: part.exists() and part.stat().st_size > 50_000, lambda: "no part")
        running.send_signal(signal.SIGINT)
        _, said = running.communicate(timeout=60)
        assert running.returncode == 1
        assert "interrupted; flight-1.ulg.part holds" in said
        assert "give the same command again to go on" in said
        assert "Traceback" not in said
        done = subprocess.run([*command, "--json"], capture_output=True, text=True, cwd=tmp_path, check=True)
        found = json.loads(done.stdout)
        assert 40_000 < found["resumed"] < SIZE
        assert (tmp_path / "out" / "flight-1.ulg").read_bytes() == content(SIZE, 0)
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["flight-1.ulg"]


def test_last_and_a_name_exclude_one_another(mimopilot):
    assert_one_clear_line(mimopilot("logs", "a.ulg", "--last", "--connect", "tcp:127.0.0.1:1"), "--last: give either")
