"""The folder of a campaign: its parts are checked, and only one campaign uses it at a time."""

import subprocess
import sys

import pytest

from mimopilot.common.errors import Error
from mimopilot.common.part_folder import PartFolder
from mimopilot.sitl.campaign.execution import run_campaign
from mimopilot.sitl.campaign.flights import CHUNK, fly_chunk
from mimopilot.sitl.campaign.plan import LOCK, PARTS, RESULTS, make_plan, write_plan_files
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.summary import summarise
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.airframe import load_airframe

RUNS = 5 * CHUNK


def plan_of(**entries):
    vehicle = load_airframe("adam0")
    given = {"runs": RUNS, "seed": 3, "manoeuvre": "doublet", "axes": ["roll"], "vary": {}}
    given |= {"amplitude_deg": 22.5, "period_s": 0.42, "tail_s": 0.5}
    return make_plan(vehicle, {"default": vehicle.default_gains()}, **(given | entries))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A plan, its results, and its parts."""
    plan = plan_of()
    results = run_campaign(plan, tmp_path_factory.mktemp("whole"), 1).read_bytes()
    return plan, results, [fly_chunk(plan.files, chunk) for chunk in range(RUNS // CHUNK)]


def begin(plan, folder, parts):
    """The folder of an interrupted campaign with these parts."""
    write_plan_files(plan, folder)
    (folder / PARTS).mkdir()
    for chunk, part in parts.items():
        (folder / PARTS / f"{chunk:07d}.part").write_bytes(part)
    return folder


def test_a_damaged_a_duplicate_and_a_foreign_part_are_flown_again_with_a_warning(flown, tmp_path, capsys):
    plan, results, parts = flown
    middle = len(parts[1]) // 2
    flipped = parts[1][:middle] + bytes([parts[1][middle] ^ 4]) + parts[1][middle + 1 :]
    foreign = fly_chunk(plan_of(seed=4).files, 3)
    folder = begin(plan, tmp_path, {0: parts[0], 1: flipped, 2: parts[0], 3: foreign})
    assert run_campaign(plan, folder, 1).read_bytes() == results
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(
        "parts: unusable parts are computed again: 0000001.part is damaged; 0000002.part is of runs 0 to 63; "
        "0000003.part is of another campaign"
    )


@pytest.mark.parametrize("kind", ["half", "zeros", "empty", "table alone", "the last one of fewer runs"])
def test_any_damage_of_a_part_leaves_the_results_the_same(flown, tmp_path, capsys, kind):
    plan, results, parts = flown
    part = parts[4]
    wrong = {
        "half": part[: len(part) // 2],
        "zeros": bytes(len(part)),
        "empty": b"",
        "table alone": part[: part.rindex(b"PAR1") + 4],
        "the last one of fewer runs": fly_chunk(plan_of(runs=RUNS - 5).files, 4),
    }
    folder = begin(plan, tmp_path, dict(enumerate(parts)) | {4: wrong[kind]})
    assert run_campaign(plan, folder, 1).read_bytes() == results
    assert "0000004.part is " in capsys.readouterr().err


def test_undamaged_parts_are_not_flown_again(flown, tmp_path, capsys, monkeypatch):
    plan, results, parts = flown
    monkeypatch.setattr("mimopilot.sitl.campaign.execution._fly_chunks", None)
    assert run_campaign(plan, begin(plan, tmp_path, dict(enumerate(parts))), 1).read_bytes() == results
    assert capsys.readouterr().err == ""


HOLDER = """
import sys
from pathlib import Path
from mimopilot.common.part_folder import folder_lock
with folder_lock(Path(sys.argv[1]), "campaign.lock", "campaign"):
    print("alone", flush=True)
    sys.stdin.read()
"""


def test_a_second_campaign_in_a_folder_is_refused_until_the_first_ends_or_is_killed(flown, tmp_path):
    plan, results, _ = flown
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "c")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "alone\n"
        with pytest.raises(
            Error,
            match="c: another process writes a campaign into this folder; wait for it, or give another --out",
        ):
            run_campaign(plan, tmp_path / "c", 1)
        assert [path.name for path in (tmp_path / "c").iterdir()] == [LOCK]
        first.kill()
    assert run_campaign(plan, tmp_path / "c", 1).read_bytes() == results


def test_damage_between_flight_and_merge_is_reported(flown, tmp_path, monkeypatch):
    plan, _, parts = flown
    folder = begin(plan, tmp_path, dict(enumerate(parts)))
    (folder / PARTS / "0000002.part").write_bytes(parts[2][:-1])
    monkeypatch.setattr(PartFolder, "missing", lambda *_: [])
    with pytest.raises(SitlError, match=r"0000002\.part is damaged; give the same command again"):
        run_campaign(plan, folder, 1)


def test_damaged_results_are_reported_or_read_correctly(flown, tmp_path):
    plan, results, _ = flown
    path = tmp_path / RESULTS
    path.write_bytes(results)
    expected, refused = summarise(CampaignResults(plan, path)), 0
    for place in range(0, len(results), len(results) // 60):
        path.write_bytes(results[:place] + bytes([results[place] ^ 8]) + results[place + 1 :])
        try:
            assert summarise(CampaignResults(plan, path)) == expected
        except SitlError as error:
            assert f"{path}: damaged; remove it" in str(error)
            refused += 1
    assert refused > 20
