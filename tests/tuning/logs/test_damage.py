"""Damaged logs: any damage leaves an experiment or gives one clear message."""

import numpy as np
import pytest
from scipy.io import savemat

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import read_log
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    make_flight,
    px4_topics,
    table,
    write_csv,
    write_ulog,
)


@pytest.fixture(scope="module", params=["ulg", "bin", "csv", "mat"])
def whole(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / f"x.{request.param}"
    flight = make_flight(6.0)
    if request.param == "ulg":
        write_ulog(path, px4_topics(flight))
    elif request.param == "bin":
        path.write_bytes(dataflash_bytes(ardupilot_messages(flight)))
    elif request.param == "csv":
        write_csv(path, table(flight))
    else:
        savemat(path, table(flight))
    return path


def damaged(content, seed):
    generator = np.random.default_rng(seed)
    data = bytearray(content)
    kind = seed % 4
    if kind == 0:
        return data[: generator.integers(len(data))]
    if kind == 1:
        start = generator.integers(len(data))
        del data[start : start + generator.integers(1, 200)]
        return data
    # Flip bits in the definitions at the beginning, or anywhere.
    span = min(len(data), 1500) if kind == 2 else len(data)
    for _ in range(generator.integers(1, 20)):
        data[generator.integers(span)] ^= 1 << int(generator.integers(8))
    return data


@pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")
def test_a_damaged_log_gives_an_experiment_or_one_message_and_prints_nothing(whole, tmp_path, capfd):
    read_log(whole)
    path = tmp_path / whole.name
    refused = 0
    for seed in range(60):
        path.write_bytes(damaged(whole.read_bytes(), seed))
        for read in (read_log, inspect_log):
            try:
                read(path)
            except TuningError as error:
                refused += 1
                assert str(path) in str(error)
                assert "\n" not in str(error)
    assert refused > 10
    assert capfd.readouterr() == ("", "")
