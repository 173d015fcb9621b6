"""Every block of README and manual does what it says."""

import re
import shlex
import shutil

import pytest
import typer.main

from mimopilot.cli.main import app
from mimopilot.sitl.campaign.variation import read_variation
from mimopilot.sitl.flight.scenario import load_scenario
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.logs.columns import load_columns
from mimopilot.tuning.spec import load_spec
from tests.conftest import run_here
from tests.docs.blocks import BLOCKS, LANGUAGES, PAGES
from tests.paths import TOP

COMMANDS = typer.main.get_command(app).commands
#: Kind of a TOML block -> its reader.
READERS = {
    "columns": load_columns,
    "spec": load_spec,
    "margins": load_spec,
    "vary": read_variation,
    "fault": read_variation,
    "scenario": lambda path: load_scenario(path, 0.004),
    "airframe": load_airframe,
    "gains": load_gains,
}
#: What all pages start from: one flight and one tuning, by the README's own commands.
FIRST = ("mimopilot experiment adam0 --seed 1 --out flight.ulg", "mimopilot tune flight.ulg --out my.gains.toml")
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")


class Folder:
    """A folder in which commands run, each once."""

    def __init__(self, path):
        self.path, self.done = path, {}

    def run(self, line):
        if line not in self.done:
            self.done[line] = run_here(self.path, *shlex.split(line)[1:])
        return self.done[line]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = Folder(tmp_path_factory.mktemp("manual"))
    for line in FIRST:
        assert folder.run(line).returncode == 0
    for name in ("siso", "mimo"):
        shutil.copy(folder.path / "my.gains.toml", folder.path / f"{name}.gains.toml")
    for block in BLOCKS:
        if kind := block.value("toml"):
            (folder.path / f"{kind}.toml").write_text(block.text)
    return folder


def is_run(block):
    return block.language in ("", "sh", "console") and block.mark != "vehicle" and block.value("test") is None


def agrees(shown, printed):
    """Equal words; figures within one unit of the last digit that is shown, whole numbers exactly."""
    if NUMBER.sub("#", " ".join(shown.split())) != NUMBER.sub("#", " ".join(printed.split())):
        return False
    for one, other in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        digits = len(one.partition(".")[2])
        if abs(float(one) - float(other)) > (1.01 * 10.0**-digits if digits else 0.0):
            return False
    return True


def test_every_block_has_a_known_language_and_a_mark_that_says_something():
    for block in BLOCKS:
        assert block.language in LANGUAGES, block.name
        kind = block.mark.partition(":")[0]
        assert kind in ("", "vehicle", "test", "run", "toml"), f"{block.name}: <!-- {block.mark} -->"
        assert (block.value("toml") in READERS) == (block.language == "toml"), block.name
        if block.language == "text":
            assert not re.search(r"^(\$ |mimopilot |make )", block.text, re.MULTILINE), block.name


def test_every_page_has_all_its_fences_in_blocks():
    for page in PAGES:
        fences = len(re.findall(r"^ *```", page.read_text(), re.MULTILINE))
        assert fences == 2 * sum(block.page == page for block in BLOCKS), page


@pytest.mark.parametrize("block", [block for block in BLOCKS if is_run(block)], ids=lambda block: block.name)
def test_a_block_of_commands_runs_and_prints_what_is_shown(folder, block):
    for line, shown in block.commands:
        for change in filter(None, (block.value("run") or "").split(";")):
            before, after = (part.strip() for part in change.split("=>"))
            line = line.replace(before, after)
        assert line.startswith("mimopilot "), f"{block.name}: {line}: mark the block"
        done = folder.run(line)
        assert done.returncode == 0, f"{line}: {done.stderr}"
        printed = iter((done.stdout + done.stderr).splitlines())
        for row in shown:
            assert any(agrees(row, other) for other in printed), f"{line} does not print: {row}\n{done.stdout}"


@pytest.mark.parametrize(
    "block",
    [b for b in BLOCKS if b.language in ("", "sh", "console") and not is_run(b)],
    ids=lambda block: block.name,
)
def test_the_commands_of_a_block_that_is_not_run_here_exist_with_these_options(block, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    for line, _ in block.commands:
        name, *arguments = shlex.split(line)[1:] if line.startswith("mimopilot ") else [None]
        if name:
            COMMANDS[name].make_context(name, arguments)
        else:
            assert block.mark == "vehicle" or line.startswith("make "), f"{block.name}: {line}"
    test = block.value("test")
    if test:
        path, _, function = test.partition("::")
        text = (TOP / path).read_text()
        assert f"\ndef {function}(" in text, f"{block.name}: {test}"
        for line, _ in block.commands:
            name = line.split()[1]
            assert line.startswith("make ") or re.search(rf'"{name}"|\b{name}\(', text), f"{block.name}: {name}"


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "toml"], ids=lambda block: block.name)
def test_a_toml_block_is_accepted_by_the_reader_of_its_kind(block, tmp_path):
    path = tmp_path / f"x.{block.value('toml')}.toml"
    path.write_text(block.text)
    READERS[block.value("toml")](path)


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "python"], ids=lambda block: block.name)
def test_a_python_block_runs(folder, block, monkeypatch):
    monkeypatch.chdir(folder.path)
    if block.mark == "vehicle":
        compile(block.text, block.name, "exec")
    else:
        exec(compile(block.text, block.name, "exec"), {})


def test_every_link_within_readme_and_manual_leads_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            if not target.startswith(("http", "#")):
                assert (page.parent / target.partition("#")[0]).exists(), f"{page.name}: {target}"


def test_the_readme_is_short():
    assert len((TOP / "README.md").read_text().splitlines()) <= 150
