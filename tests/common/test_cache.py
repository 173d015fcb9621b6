"""The cache of machine code: no code of other users is run, and a damaged file is compiled again."""

import importlib.util
import os
import tempfile

import pytest

from mimopilot.common.cache import _temporary, cache_folder

MODULE = """
from mimopilot.common.compiled import compiled

@compiled
def double(x):
    return 2 * x

@compiled
def triple(x):
    return 3 * x
"""


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Folders for the cache and for temporary files, set in the environment."""
    usual, temporary = tmp_path / "usual", tmp_path / "temporary"
    usual.mkdir(mode=0o755)
    temporary.mkdir(mode=0o755)
    monkeypatch.setenv("XDG_CACHE_HOME", str(usual))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    _temporary.cache_clear()
    yield usual, temporary
    _temporary.cache_clear()


def change_owner(folder, monkeypatch):
    """Change the owner; without root rights, change our own user instead."""
    if os.geteuid() == 0:
        os.chown(folder, 12345, -1)
    else:
        monkeypatch.setattr("mimopilot.common.cache.os.geteuid", lambda: os.getuid() + 1)


def test_the_usual_folder_is_created_private_to_its_owner(places):
    usual, _ = places
    assert cache_folder() == usual / "mimopilot"
    assert (usual / "mimopilot").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o702, 0o1777])
def test_a_folder_that_others_can_write_to_is_not_used(places, mode):
    usual, temporary = places
    (usual / "mimopilot").mkdir()
    (usual / "mimopilot").chmod(mode)
    fallback = temporary / f"mimopilot-{os.geteuid()}"
    assert cache_folder() == fallback
    assert fallback.stat().st_mode & 0o777 == 0o700
    fallback.chmod(mode)
    found = cache_folder()
    assert found.parent == temporary
    assert found != fallback
    assert found.stat().st_mode & 0o777 == 0o700
    assert not list((usual / "mimopilot").iterdir()) + list(fallback.iterdir())


def test_a_shared_parent_folder_needs_the_sticky_bit(places):
    usual, temporary = places
    usual.chmod(0o1777)
    assert cache_folder() == usual / "mimopilot"
    usual.chmod(0o777)  # anybody may replace the folder
    assert cache_folder().parent == temporary


def test_a_folder_of_another_owner_is_not_used(places, monkeypatch):
    usual, _ = places
    (usual / "mimopilot").mkdir(mode=0o700)
    change_owner(usual / "mimopilot", monkeypatch)
    assert cache_folder() != usual / "mimopilot"


def test_a_link_is_judged_by_the_folder_that_it_leads_to(places, tmp_path):
    usual, temporary = places
    (tmp_path / "own").mkdir(mode=0o700)
    (usual / "mimopilot").symlink_to(tmp_path / "own")
    assert cache_folder() == tmp_path / "own"
    (tmp_path / "own").chmod(0o777)
    assert cache_folder().parent == temporary
    for target in ("mimopilot", "nothing/at/all"):
        (usual / "mimopilot").unlink()
        (usual / "mimopilot").symlink_to(target)
        assert cache_folder().parent == temporary


def test_without_a_home_folder_the_temporary_folder_is_used(places, monkeypatch):
    def no_home(_):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setattr("pathlib.Path.expanduser", lambda path: path if path.is_absolute() else no_home(path))
    assert cache_folder() == places[1] / f"mimopilot-{os.geteuid()}"


def load(path):
    specification = importlib.util.spec_from_file_location("functions", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


DAMAGE = {
    "half of it": lambda content: content[: len(content) // 2],
    "nothing": lambda content: b"",
    "zeros": lambda content: bytes(len(content)),
    "one byte": lambda content: content[:999] + bytes([content[999] ^ 1]) + content[1000:],
    "text": lambda content: b"not machine code\n",
}


def test_machine_code_that_is_damaged_or_of_another_function_is_compiled_again(places, tmp_path):
    (tmp_path / "functions.py").write_text(MODULE)

    def hits():
        module = load(tmp_path / "functions.py")
        assert (module.double(21.0), module.triple(21.0)) == (42.0, 63.0)
        return [sum(function.stats.cache_hits.values()) for function in (module.double, module.triple)]

    assert hits() == [0, 0]
    assert hits() == [1, 1]
    double, triple = sorted(places[0].rglob("*.nbc"))
    kept = triple.read_bytes()
    for damage in DAMAGE.values():
        whole = double.read_bytes()
        double.write_bytes(damage(whole))
        assert hits() == [0, 1]
        assert hits() == [1, 1]
    double.write_bytes(kept)
    assert hits() == [0, 1]
    assert triple.read_bytes() == kept


def test_functions_are_compiled_if_the_disk_is_full(places, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mimopilot.common.compiled.write_atomically", full)
    (tmp_path / "functions.py").write_text(MODULE)
    assert load(tmp_path / "functions.py").double(21.0) == 42.0


def test_machine_code_for_other_types_is_not_loaded_from_the_same_file(places, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "mimopilot.common.compiled._SealedFiles._path", lambda self, key: self.folder / f"{self.name}.nbc"
    )
    (tmp_path / "functions.py").write_text(MODULE)
    assert load(tmp_path / "functions.py").double(21.5) == 43.0
    other = load(tmp_path / "functions.py").double
    assert other(21) == 42
    assert not other.stats.cache_hits
