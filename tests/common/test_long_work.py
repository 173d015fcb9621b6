"""Long work in pieces: kept, resumed, shown, and interrupted."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mimopilot.common import progress
from mimopilot.common.errors import Error
from mimopilot.common.long_work import Piece, program_digest, run_pieces


def square(task):
    """n squared; leaves a file for each call."""
    folder, n = task
    (folder / f"{n}-{time.monotonic_ns()}").touch()
    return {"n": n, "square": n * n, "third": 1 / 3, "lost": math.inf}


def total(folder, *results):
    (folder / f"sum-{time.monotonic_ns()}").touch()
    return sum(result["square"] for result in results)


def pieces_of(calls, numbers=(1, 2, 3), version="1"):
    calls.mkdir(exist_ok=True)
    squares = [Piece(f"square-{n}", square, (calls, n), f"{n} {version if n == 2 else ''}") for n in numbers]
    return [*squares, Piece("sum", total, calls, "", tuple(piece.name for piece in squares))]


def calls_of(folder):
    return sorted(path.name.partition("-")[0] for path in folder.iterdir())


def test_results_are_those_of_the_functions_and_are_not_computed_twice(tmp_path):
    calls, out, kept = tmp_path / "calls", tmp_path / "out", []
    first = run_pieces(pieces_of(calls), out, 2, "test", lambda name, result: kept.append(name))
    assert list(first) == ["square-1", "square-2", "square-3", "sum"]
    assert first["square-3"] == {"n": 3, "square": 9, "third": 1 / 3, "lost": math.inf}
    assert first["sum"] == 14
    assert sorted(kept) == sorted(first)
    assert calls_of(calls) == ["1", "2", "3", "sum"]
    assert run_pieces(pieces_of(calls), out, 1, "test") == first
    assert calls_of(calls) == ["1", "2", "3", "sum"]
    # One more piece: only it and what comes after it.
    assert run_pieces(pieces_of(calls, (1, 2, 3, 4)), out, 2, "test")["sum"] == 30
    assert calls_of(calls) == ["1", "2", "3", "4", "sum", "sum"]


def test_a_changed_input_or_another_program_is_computed_again(tmp_path, monkeypatch, capsys):
    calls, out = tmp_path / "calls", tmp_path / "out"
    run_pieces(pieces_of(calls), out, 1, "test")
    capsys.readouterr()
    run_pieces(pieces_of(calls, version="2"), out, 1, "test")
    assert calls_of(calls) == ["1", "2", "2", "3", "sum", "sum"]
    assert "square-2.part is of another version or set of options; sum.part is of another" in capsys.readouterr().err
    monkeypatch.setattr("mimopilot.common.long_work.program_digest", lambda: "edited")
    run_pieces(pieces_of(calls, version="2"), out, 1, "test")
    assert len(calls_of(calls)) == 10


def test_a_damaged_part_is_computed_again_with_a_warning(tmp_path, capsys):
    calls, out = tmp_path / "calls", tmp_path / "out"
    first = run_pieces(pieces_of(calls), out, 1, "test")
    path = out / "parts" / "square-1.part"
    path.write_bytes(path.read_bytes().replace(b'"square": 1', b'"square": 7'))
    capsys.readouterr()
    assert run_pieces(pieces_of(calls), out, 1, "test") == first
    assert "square-1.part is damaged" in capsys.readouterr().err
    assert calls_of(calls) == ["1", "1", "2", "3", "sum"]


def test_a_piece_that_waits_for_an_unknown_one_is_a_mistake_of_the_program(tmp_path):
    with pytest.raises(KeyError, match="missing"):
        run_pieces([Piece("sum", total, tmp_path, "", ("missing",))], tmp_path, 1, "test")


def test_the_program_is_the_same_for_every_call_and_all_its_folders_count():
    assert program_digest() == program_digest()
    assert len(program_digest()) == 64


def test_a_second_process_in_the_same_folder_is_refused(tmp_path):
    script = (
        "import sys\nfrom pathlib import Path\nfrom mimopilot.common.part_folder import folder_lock\n"
        "with folder_lock(Path(sys.argv[1]), 'parts.lock', 'study'):\n print('held', flush=True)\n sys.stdin.read()"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(Error, match="another process writes a study into this folder"):
            run_pieces(pieces_of(tmp_path / "calls"), tmp_path, 1, "test")
        holder.kill()


def test_progress_is_a_line_at_once_and_one_every_interval(monkeypatch, capsys):
    monkeypatch.setattr(progress, "INTERVAL_S", 0.05)
    with progress.progress("work", 9, 4) as advance:
        assert capsys.readouterr().err == "work: 4 of 9 done, 0 s\n"
        advance()
        deadline = time.monotonic() + 30
        while "work: 5 of 9 done" not in (shown := capsys.readouterr().err):
            assert time.monotonic() < deadline, shown
            time.sleep(0.01)


SLEEPER = """
import sys, time
from pathlib import Path
from mimopilot.common.errors import Error
from mimopilot.common.long_work import Piece, run_pieces
def work(seconds):
    time.sleep(seconds)
    return seconds
pieces = [Piece(f"p{i}", work, 0.01 if i < 3 else float(sys.argv[2]), str(i)) for i in range(6)]
try:
    print(run_pieces(pieces, Path(sys.argv[1]), 2, "sleeping"))
except Error as error:
    print(error)
    sys.exit(error.exit_code)
"""


def heed_ctrl_c():
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # background jobs of a shell ignore it, and so do their children


def children_of(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_ctrl_c_ends_within_two_seconds_and_the_same_call_goes_on(tmp_path):
    def command(seconds):
        return [sys.executable, "-c", SLEEPER, str(tmp_path / "out"), str(seconds)]

    process = subprocess.Popen(
        command(600), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c
    )
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "out").glob("parts/p*.part"))) < 3:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    workers = children_of(process.pid)
    assert len(workers) == 2
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    message, _ = process.communicate(timeout=60)
    assert time.monotonic() - begin < 2.0
    assert process.returncode == 130
    assert message == "interrupted after 3 of 6 pieces; give the same command again to resume\n"
    assert not any(is_running(pid) for pid in workers)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "parts").iterdir()}
    assert sorted(path.name for path in kept) == ["p0.part", "p1.part", "p2.part"]
    done = subprocess.run(command(0.01), capture_output=True, text=True, check=True, env=os.environ)
    assert "sleeping: 3 of 6 done, 0 s" in done.stderr
    assert "'p5': 0.01" in done.stdout
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
