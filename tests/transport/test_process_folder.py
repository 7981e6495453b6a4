"""Folders that a killed process has left are removed; what is in use, and what is a user's own, never is."""

import os
import tempfile
from pathlib import Path

import pytest

from semantic_mapper.transport.process_folder import OwnFolder, is_in_use, sweep


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A TMPDIR that is shared with another container, whose process numbers mean nothing here."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(os, "getpid", lambda: 99_999_999)
    return tmp_path


def die(folder: OwnFolder) -> None:
    """What the kernel does where the process is killed."""
    folder._lock.release()


def test_only_what_its_process_has_left_is_removed(elsewhere: Path) -> None:
    own = elsewhere / "semantic-mapper-20261123-maps"
    own.mkdir()
    (own / "map.npz").write_text("of weeks")
    used, left = OwnFolder(), OwnFolder("view-")
    assert used.path.name.startswith("semantic-mapper-99999999-") and used.path.stat().st_mode & 0o777 == 0o700
    (left.path / "mapper").write_text("a socket")
    assert is_in_use(used.path) and is_in_use(left.path) and not is_in_use(own)
    die(left)
    assert not is_in_use(left.path)
    sweep()
    assert sorted(elsewhere.iterdir()) == sorted([own, used.path]) and (own / "map.npz").exists()
    assert is_in_use(used.path)
    used.close()
    used.close()
    assert list(elsewhere.iterdir()) == [own]


def test_a_folder_that_just_begins_is_left_alone(elsewhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = Path.rename

    def sweep_before(path: Path, target: Path) -> Path:
        sweep()
        done = rename(path, target)
        sweep()
        return done

    monkeypatch.setattr(Path, "rename", sweep_before)
    folder = OwnFolder()
    assert is_in_use(folder.path)
    folder.close()
