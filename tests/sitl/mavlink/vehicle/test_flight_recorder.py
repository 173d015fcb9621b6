"""The flight recorder: file numbers, and files that cannot be written."""

import pytest
from pyulog import ULog

from mimopilot.sitl.autopilot.flight_modes import Commander
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.vehicle.flight_recorder import FlightRecorder
from mimopilot.sitl.physics.airframe import load_airframe

TS = 0.004


@pytest.fixture(scope="module")
def model():
    return load_airframe("adam0")


def record_flight(log, model, seconds):
    """Record one flight; each row holds its time."""
    vehicle = Commander(0.5)
    log.begin({"MIMO_TS": TS})
    for k in range(round(seconds / TS)):
        log.next_row(vehicle)["rates"] = k * TS


def seconds(path):
    return len(ULog(str(path)).get_dataset("vehicle_land_detected").data["timestamp"]) * TS


def test_a_flight_that_cannot_be_written_keeps_its_number_and_is_written_later(model, tmp_path):
    folder = tmp_path / "logs"
    log = FlightRecorder(folder / "f.ulg", model.airframe, TS)
    record_flight(log, model, 1.0)
    assert log.save() == [folder / "f.ulg"]
    folder.rename(tmp_path / "away")
    folder.write_text("no folder any more")
    for flight in (2.0, 3.0):
        record_flight(log, model, flight)
        with pytest.raises(OSError, match="File exists"):
            log.save()
    assert log.unsaved == [folder / "f-2.ulg", folder / "f-3.ulg"]
    folder.unlink()
    (tmp_path / "away").rename(folder)
    record_flight(log, model, 4.0)
    assert log.save() == [folder / f"f-{n}.ulg" for n in (2, 3, 4)]
    assert [seconds(folder / name) for name in ("f.ulg", "f-2.ulg", "f-3.ulg", "f-4.ulg")] == [1.0, 2.0, 3.0, 4.0]
    assert (log.save(), log.unsaved, log.flights) == ([], [], 4)


def test_a_folder_cannot_be_the_log(model, tmp_path):
    with pytest.raises(SitlError, match="cannot be written there"):
        FlightRecorder(tmp_path, model.airframe, TS)
    assert list(tmp_path.iterdir()) == []
