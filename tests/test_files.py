"""Files that people name are read with a limit, and never waited for."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import atomic_folder, atomic_write, open_unlinked, read_regular, remove_stale, write_bytes


def test_a_regular_file_is_read_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_regular(path, 5) == b"12345"
    with pytest.raises(ConfigError, match=r"file: is larger than the limit of 4 bytes"):
        read_regular(path, 4)
    assert read_regular(Path("/proc/self/status"), 1 << 20).startswith(b"Name:")  # has no size


def test_what_may_never_end_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (Path("/dev/zero"), tmp_path / "fifo", tmp_path):
        with pytest.raises(ConfigError, match=f"{path}: is no regular file"):
            read_regular(path, 10)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "gone", 10)


def test_a_link_is_replaced_and_what_it_points_to_stays(tmp_path: Path) -> None:
    (tmp_path / "target").write_bytes(b"precious")
    (tmp_path / "file").symlink_to(tmp_path / "target")
    write_bytes(tmp_path / "file", b"result")
    assert (tmp_path / "target").read_bytes() == b"precious"
    assert not (tmp_path / "file").is_symlink() and (tmp_path / "file").read_bytes() == b"result"
    (tmp_path / "link").symlink_to(tmp_path / "target")
    for flags in (os.O_WRONLY | os.O_CREAT, os.O_WRONLY | os.O_APPEND):
        with pytest.raises(OSError, match="link"):
            open_unlinked(tmp_path / "link", flags)


def test_an_error_leaves_the_file_as_it_was_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), atomic_write(path) as file:
        file.write(bytes([1 // 0]))
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileNotFoundError) as caught, atomic_write(tmp_path / "none" / "file"):
        pass
    assert caught.value.filename == str(tmp_path / "none" / "file")


def test_what_killed_writers_left_is_removed_and_what_is_being_written_stays(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    start = "import os, signal; from pathlib import Path; from semantic_mapper.files import atomic_write\n"
    killed = f"with atomic_write(Path({str(path)!r})) as f:\n    f.write(b'x'); os.kill(os.getpid(), signal.SIGKILL)"
    assert subprocess.run([sys.executable, "-c", start + killed], check=False).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".map.npz.") and left.name.endswith(".part")
    others = (tmp_path / ".hidden.part", tmp_path / "map.npz.part", tmp_path / ".map.npz.nothexnothex.part")
    for other in others:
        other.touch()
    with atomic_write(tmp_path / "other") as file:
        file.write(b"y")
        assert remove_stale(tmp_path, "other") == []
        assert remove_stale(tmp_path) == [left]
    assert sorted(tmp_path.iterdir()) == sorted((*others, tmp_path / "other"))


def test_what_reaches_the_disk_is_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(Path(os.readlink(f"/proc/self/fd/{fd}"))))
    write_bytes(tmp_path / "file", b"1", sync="none")
    assert synced == []
    write_bytes(tmp_path / "file", b"2")
    assert [path.parent for path in synced] == [tmp_path]
    write_bytes(tmp_path / "file", b"3", sync="folder")
    assert synced[-1] == tmp_path and len(synced) == 3


def test_a_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "out") as draft:
        (draft / "file").touch()
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out" / "file").exists()
    with pytest.raises(ZeroDivisionError), atomic_folder(tmp_path / "other"):
        assert 1 // 0
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]
