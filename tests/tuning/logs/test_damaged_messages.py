"""A damaged byte costs only its own message, in both formats, and the loss is reported."""

import struct
import tracemalloc

import numpy as np
import pytest
from pyulog import ULog

from mimopilot.sitl.flight.ulog_writer import HEADER, _message
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.dataflash_file import open_dataflash
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.logs.ulog_file import open_ulog
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    make_flight,
    px4_topics,
    write_ulog,
)


@pytest.fixture(scope="module")
def flight():
    return make_flight(6.0)


def dataflash(path, flight):
    path.write_bytes(dataflash_bytes(ardupilot_messages(flight)))
    return open_dataflash, lambda log: sum(len(offsets) for offsets in log.offsets.values())


def ulog(path, flight):
    write_ulog(path, px4_topics(flight))
    return open_ulog, lambda log: sum(len(topic.offsets) for topic in log.topics.values())


@pytest.mark.parametrize("write", [dataflash, ulog])
def test_a_flipped_bit_costs_one_message_at_most(tmp_path, flight, write):
    path = tmp_path / "x"
    read, count = write(path, flight)
    whole, content = count(read(path)), path.read_bytes()
    assert read(path).damage == ""
    generator = np.random.default_rng(3)
    lost = []
    for _ in range(150):
        data = bytearray(content)
        data[generator.integers(1500, len(data) - 100)] ^= 1 << int(generator.integers(8))
        path.write_bytes(data)
        log = read(path)
        lost.append(whole - count(log))
        assert bool(log.damage) or lost[-1] == 0
    assert set(lost) == {0, 1}


@pytest.mark.parametrize(("write", "size"), [(dataflash, 27), (ulog, 33)])
def test_skipped_bytes_are_counted_and_reported_by_every_reader_of_the_log(tmp_path, flight, write, size):
    path = tmp_path / "x"
    read, count = write(path, flight)
    whole, data = count(read(path)), bytearray(path.read_bytes())
    log = read(path)
    first = log.offsets["RATE"] if write is dataflash else log.topics[0].offsets
    data[first[700] + 2] = 0xEE
    path.write_bytes(data)
    assert count(read(path)) == whole - 1
    told = f"damaged: {size} of {len(data)} bytes, in 1 place, are not valid messages and ignored"
    assert read_log(path).warnings == (told,)
    assert inspect_log(path).warnings == (told,)
    assert read_log(path).segments == ((0, len(flight.t)),)
    # If the log is refused, the damage is reported beside the reason.
    path.write_bytes(data[: first[750]])
    with pytest.raises(TuningError, match=f"damaged: {size} of"):
        read_log(path)


@pytest.mark.parametrize("write", [dataflash, ulog])
def test_the_message_before_a_damaged_one_is_kept(tmp_path, flight, write):
    path = tmp_path / "x"
    read, _ = write(path, flight)
    log, data = read(path), bytearray(path.read_bytes())
    first = log.offsets["RATE"] if write is dataflash else log.topics[0].offsets
    data[first[300] + 1] ^= 0x40
    path.write_bytes(data)
    left = read(path).offsets["RATE"] if write is dataflash else read(path).topics[0].offsets
    assert set(first) - set(left) == {first[300]}


def test_a_ulog_size_that_spans_two_messages_is_detected(tmp_path, flight):
    path = tmp_path / "x"
    read, count = ulog(path, flight)
    log, data = read(path), bytearray(path.read_bytes())
    first, second = log.topics[0].offsets[300:302]
    data[first] += second - first
    path.write_bytes(data)
    assert count(log) - count(read(path)) == 1
    assert f"damaged: {second - first} of" in read(path).damage


@pytest.mark.parametrize("write", [dataflash, ulog])
def test_a_truncated_file_is_reported_and_padding_is_not_damage(tmp_path, flight, write):
    path = tmp_path / "x"
    read, _ = write(path, flight)
    content = path.read_bytes()
    path.write_bytes(content[:-5])
    assert read(path).damage == "the file ends inside a message: the download is incomplete or power was lost"
    if write is dataflash:
        path.write_bytes(content + b"\xff" * 512)
        assert read(path).damage == ""


def test_a_definition_with_a_wrong_length_does_not_lose_other_messages(tmp_path, flight):
    rate, angles = ardupilot_messages(flight)
    other = ("XYZ", "Qf", ("TimeUS", "Value"), [rate[3][0][:100], np.zeros(100)])
    data = bytearray(dataflash_bytes([other, rate, angles]))
    data[89 + 4] = 250  # the length in the first definition
    (tmp_path / "x.bin").write_bytes(data)
    log = read_log(tmp_path / "x.bin")
    assert log.segments == ((0, len(flight.t)),)
    assert log.warnings[0].startswith("damaged: 1500 of ")


def test_topics_and_parameters_equal_those_of_pyulog(tmp_path, flight):
    path = write_ulog(
        tmp_path / "x.ulg", px4_topics(flight), {"A": 1.5, "B": -2.0}, [(12.0, "A", 3.0), (13.0, "C", 4.0)]
    )
    ours, theirs = open_ulog(path), ULog(str(path))
    assert ours.parameters == theirs.initial_parameters
    assert [(round(t * 1e6), n, v) for t, n, v in ours.changes] == theirs.changed_parameters
    assert ours.information["ver_sw_release"] == 0x010D02FF
    for topic in theirs.data_list:
        fields = ours.fields(topic.name)
        assert set(fields) == set(topic.data)
        assert all((fields[name] == values).all() for name, values in topic.data.items())


def hostile(*definitions, name=b"t0", subscriptions=1):
    formats = b"".join(_message("F", definition) for definition in definitions)
    added = b"".join(_message("A", struct.pack("<BH", 0, i) + name) for i in range(subscriptions))
    return HEADER + bytes(8) + formats + added


def chain(depth, field):
    return [f"t{i}:{''.join(field.format(i + 1, j) for j in range(9))}".encode() for i in range(depth)]


@pytest.mark.parametrize(
    "content",
    [
        hostile(*chain(12, "t{0}[999] f{1};"), b"t12:float x;"),
        hostile(b"t0:t1 a;", b"t1:t0 a;"),
        hostile(b"t0:uint64_t timestamp;float[99999] q;", subscriptions=300),
        hostile(b"t0:" + b"uint8_t a;" * 9),
    ],
    ids=["nested", "circle", "array", "twice"],
)
def test_an_impossible_format_is_refused_without_allocating_memory(tmp_path, content):
    (tmp_path / "x.ulg").write_bytes(content)
    tracemalloc.start()
    with pytest.raises(TuningError, match="damaged ULog file: messages of t0 would have more than 65535 bytes"):
        read_log(tmp_path / "x.ulg")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000  # bytes


def test_wide_topics_without_messages_allocate_no_memory(tmp_path):
    (tmp_path / "x.ulg").write_bytes(hostile(b"t0:uint64_t timestamp;uint8_t[65000] q;", subscriptions=300))
    tracemalloc.start()
    with pytest.raises(TuningError, match="lacks vehicle_torque_setpoint"):
        read_log(tmp_path / "x.ulg")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000  # bytes


def test_a_topic_with_a_damaged_format_is_named_and_the_others_are_read(tmp_path, flight):
    path = write_ulog(tmp_path / "x.ulg", px4_topics(flight))
    path.write_bytes(
        path.read_bytes().replace(b"vehicle_attitude_setpoint:uint64_t", b"vehicle_attitude_setpoint:uint66_t")
    )
    log = read_log(path)
    assert log.r_o is None
    assert log.u == pytest.approx(flight.u, abs=1e-6)
    assert "the format of vehicle_attitude_setpoint is not defined; these topics are not read" in log.warnings[0]


def test_a_message_with_a_damaged_format_is_named_beside_the_missing_signals(tmp_path, flight):
    data = bytearray(dataflash_bytes(ardupilot_messages(flight)))
    data[data.index(b"Qffff\0")] = ord("X")
    (tmp_path / "x.bin").write_bytes(data)
    with pytest.raises(TuningError, match=r"lacks message RATE .*the format of RATE is unknown or damaged"):
        read_log(tmp_path / "x.bin")


def test_the_fields_logged_instead_are_named(tmp_path, flight):
    data = dataflash_bytes(ardupilot_messages(flight)).replace(b"ROut,POut", b"ROvt,POut")
    (tmp_path / "x.bin").write_bytes(data)
    with pytest.raises(TuningError, match=r"message RATE \(ROut, POut\), which has TimeUS, R, P, ROvt, POut;"):
        read_log(tmp_path / "x.bin")
