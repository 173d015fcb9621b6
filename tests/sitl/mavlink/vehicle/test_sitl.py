"""`mimopilot sitl` flown by real clients, and its reaction to killed processes."""

import math
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink
from pyulog import ULog

from mimopilot.sitl.autopilot.flight_modes import Mode
from mimopilot.sitl.mavlink.wire.px4_modes import custom_mode
from mimopilot.tuning.parameters import EXCITATION, IDENTITY, PARAMETERS
from tests.sitl.mavlink.running import PATIENCE_S, Pilot, Program, free_port, running_sitl, start, wait_for

ARM, TAKEOFF, LAND, SET_MODE = 400, 22, 21, 176
ACCEPTED, TEMPORARILY_REJECTED = 0, 1


class Sender:
    """Sends an attitude setpoint repeatedly, as a companion computer does."""

    def __init__(self, pilot, seconds):
        self.pilot, self.seconds = pilot, seconds
        self.roll = 0.0
        self.on = True
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self):
        while self.on:
            q = [math.cos(self.roll / 2), math.sin(self.roll / 2), 0, 0]
            self.pilot.link.mav.set_attitude_target_send(0, 1, 1, 7 | 64, q, 0, 0, 0, 0)
            time.sleep(self.seconds)

    def stop(self):
        self.on = False
        self.thread.join()


def in_offboard(pilot):
    """Whether it flies OFFBOARD, again after a pause in which a busy machine sent no setpoints."""
    return pilot.beat.custom_mode == custom_mode(Mode.OFFBOARD) or pilot.command(SET_MODE, 1, 6) == ACCEPTED


def test_a_pilot_arms_takes_off_flies_a_doublet_and_lands_and_the_flight_is_logged(tmp_path):
    with running_sitl("--speed", "2", "--log", tmp_path / "flight.ulg") as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        assert not pilot.armed()
        pilot.ready()
        assert pilot.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 3) == TEMPORARILY_REJECTED
        pilot.hears("no take-off: not armed")
        assert pilot.command(SET_MODE, 1, 6) == TEMPORARILY_REJECTED
        pilot.hears("no setpoints arrive")
        assert pilot.command(ARM, 1) == ACCEPTED
        assert pilot.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 3) == ACCEPTED
        pilot.flies(Mode.TAKEOFF)
        pilot.flies(Mode.HOLD)
        assert pilot.armed()
        assert pilot.command(ARM, 0) == TEMPORARILY_REJECTED  # in the air
        sender = Sender(pilot, 0.01)
        pilot.wait(lambda: pilot.command(SET_MODE, 1, 6) == ACCEPTED)
        pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, 10_000)
        for roll in (0.3, -0.3, 0.0):
            sender.roll = roll
            pilot.wait(lambda roll=roll: in_offboard(pilot) and abs(pilot.asks("ATTITUDE").roll - roll) < 0.05)
        sender.stop()
        # No more setpoints: level, then landing.
        pilot.hears("no setpoints for 0.5 s: level")
        pilot.hears("no setpoints for 2.5 s: landing")
        pilot.hears("disarmed: landed")
        pilot.wait(lambda: not pilot.armed())
        pilot.hears("logged: flight.ulg")
        pilot.close()
    log = ULog(str(tmp_path / "flight.ulg"))
    attitude = log.get_dataset("vehicle_attitude").data
    assert set(np.diff(attitude["timestamp"])) == {4000}
    landed = log.get_dataset("vehicle_land_detected").data["landed"]
    assert landed[0] == 1
    assert 0.5 < np.mean(landed == 0) < 1.0
    commands = log.get_dataset("actuator_motors").data
    assert max(commands[f"control[{i}]"].max() for i in range(4)) > 0.4


def test_a_plant_killed_in_flight_is_reported_within_a_second_and_restarted(tmp_path):
    with running_sitl("--log", tmp_path / "f.ulg") as sitl:
        pilot = Pilot(f"tcp:127.0.0.1:{sitl.tcp}")
        pilot.ready()
        assert pilot.command(ARM, 1) == ACCEPTED
        assert pilot.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 1) == ACCEPTED
        pilot.flies(Mode.TAKEOFF)
        pilot.wait(lambda: getattr(pilot.last, "relative_alt", 0) > 200)
        (plant,) = children(sitl.process.pid)
        os.kill(plant, signal.SIGKILL)
        assert pilot.hears("the plant disconnected") <= 3  # within a second
        sitl.until("the plant disconnected")
        assert pilot.command(ARM, 1) in (ACCEPTED, TEMPORARILY_REJECTED)  # answered all the time
        beats = pilot.beats
        pilot.wait(lambda: pilot.beats > beats + 1)
        pilot.texts.clear()
        pilot.ready()
        assert pilot.command(ARM, 1) == ACCEPTED
        beats = pilot.beats
        pilot.wait(lambda: pilot.armed() and pilot.beats > beats + 1)
        assert children(sitl.process.pid) != [plant]
        pilot.close()
    assert (tmp_path / "f.ulg").is_file()  # the flight before the loss
    assert (tmp_path / "f-2.ulg").is_file()  # the flight at the end


def test_a_scenario_is_flown_from_the_ground_to_the_ground_and_equal_seeds_give_equal_logs(mimopilot, tmp_path):
    links = ("--ground-port", free_port(socket.SOCK_DGRAM), "--vehicle-port", 0, "--tcp-port", 0)
    scenario = ("--scenario", "doublet", "--axis", "pitch", "--amplitude-deg", 15, "--speed", "max")
    for name, seed in (("a.ulg", 3), ("b.ulg", 3), ("c.ulg", 4)):
        result = mimopilot("sitl", "adam0", *links, *scenario, "--seed", seed, "--log", name)
        assert result.returncode == 0, result.stderr
        assert "disarmed: landed" in result.stdout
    a, b, c = ((tmp_path / name).read_bytes() for name in ("a.ulg", "b.ulg", "c.ulg"))
    assert a == b
    assert a != c
    attitude = ULog(str(tmp_path / "a.ulg")).get_dataset("vehicle_attitude_setpoint").data
    pitch = np.degrees(2 * np.arcsin(attitude["q_d[2]"]))
    assert (pitch.max(), pitch.min()) == (pytest.approx(15.0, abs=0.01), pytest.approx(-15.0, abs=0.01))


def children(parent):
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if stat.read_text().rsplit(")", 1)[1].split()[1] == str(parent):
                found.append(int(stat.parent.name))
        except OSError:
            continue
    return found


def runs(process):
    """Whether it exists and is not a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def until_gone(process):
    wait_for(lambda: not runs(process), lambda: "the plant outlives its host")


def test_a_plant_ends_when_its_host_is_killed():
    with running_sitl() as sitl:
        (plant,) = children(sitl.process.pid)
        sitl.process.kill()
        sitl.process.wait()
        until_gone(plant)


def test_ctrl_c_ends_both_processes_and_prints_the_response_times():
    with running_sitl() as sitl:
        (plant,) = children(sitl.process.pid)
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        pilot.ready()
        pilot.close()
        sitl.process.send_signal(signal.SIGINT)
        assert sitl.process.wait(timeout=PATIENCE_S) == 0
        sitl.until("answered within")
        until_gone(plant)


def test_the_host_waits_for_an_external_plant_and_reconnects_to_it():
    port = free_port()
    with running_sitl("--plant", f"127.0.0.1:{port}") as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        assert pilot.beat.system_status == mavlink.MAV_STATE_BOOT
        assert pilot.command(ARM, 1) == TEMPORARILY_REJECTED
        pilot.hears("no plant is connected")
        for _ in range(2):
            pilot.texts.clear()
            plant = start("plant", "adam0", "--port", port)
            pilot.hears("plant connected")
            pilot.ready()
            plant.process.kill()
            assert pilot.hears("the plant disconnected") <= 3
            plant.end()
        pilot.close()


@pytest.mark.parametrize("way", ["udp", "tcp"])
def test_mavproxy_connects_without_an_error_sets_parameters_and_flies(tmp_path, way):
    with running_sitl("--speed", "5") as sitl:
        address = f"udp:127.0.0.1:{sitl.udp}" if way == "udp" else f"tcp:127.0.0.1:{sitl.tcp}"
        modules = "--default-modules=param,link,arm,mode,cmdlong"
        proxy = Program(sys.executable, "-m", "MAVProxy.mavproxy", f"--master={address}", modules, cwd=tmp_path)
        try:
            proxy.until(f"Received {len(PARAMETERS + IDENTITY + EXCITATION) + 2} parameters")
            for word in ("rror", "imeout", "raceback"):
                assert word not in proxy.output.replace("no tty", "")
            proxy.say("param set MIMO_RP_RR 0.12")

            def shown():
                proxy.say("param fetch MIMO_RP_RR")
                time.sleep(0.5)
                proxy.say("param show MIMO_RP_RR")
                proxy.until("MIMO_RP_RR       0.1")
                return "MIMO_RP_RR       0.11999999731779099" in proxy.output

            wait_for(shown, lambda: proxy.output)

            def armed():
                proxy.say("arm throttle")
                time.sleep(0.5)
                return "COMPONENT_ARM_DISARM: ACCEPTED" in proxy.output

            wait_for(armed, lambda: proxy.output)  # the pre-arm check may still fail
            proxy.say("takeoff 2")
            proxy.until("mode hold")
            proxy.say(f"mode {custom_mode(Mode.LAND)}")
            proxy.until("disarmed: landed")
        finally:
            proxy.process.kill()  # it does not always end on SIGTERM
            proxy.end()
