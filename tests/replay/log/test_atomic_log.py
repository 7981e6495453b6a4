"""A log that cannot be finished leaves nothing, and says so."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import LogError
from semantic_mapper.replay.importers import import_recording
from semantic_mapper.replay.log.format import LogReader, atomic_log, recover
from semantic_mapper.transport.messages import StreamInfo
from tests.replay import recordings as rec
from tests.replay.log.test_recording import Disk


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return rec.make_folder(tmp_path / "kitchen")


@pytest.mark.parametrize("room", [0, 10_000])
def test_on_a_full_disk_an_import_and_a_recovery_leave_nothing(
    recording: Path, tmp_path: Path, room: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log.mcap"
    import_recording(recording, log)
    assert log.stat().st_size > 20_000
    small = tmp_path / "small"
    small.mkdir()
    disk = Disk(small, room, monkeypatch)
    for make, source in ((import_recording, recording), (recover, log)):
        with pytest.raises(LogError, match=r"No space left on device.*nothing of it was left") as caught:
            make(source, small / "new.mcap")
        assert str(caught.value).startswith(f"{small / 'new.mcap'}: ") and "can be read" not in str(caught.value)
        assert not list(small.iterdir())
    disk.size = 1 << 30
    recover(log, small / "new.mcap")
    with LogReader(small / "new.mcap") as reader:
        assert len(reader) == 6


def test_a_log_that_is_to_be_replaced_stays_until_the_new_one_is_whole(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = tmp_path / "small"
    small.mkdir()
    (small / "old.mcap").write_bytes(b"old")
    Disk(small, 10_000, monkeypatch)
    with pytest.raises(LogError, match="No space left"):
        import_recording(recording, small / "old.mcap", overwrite=True)
    assert [file.read_bytes() for file in small.iterdir()] == [b"old"]


def test_what_fails_beside_the_writing_is_not_taken_for_a_full_disk(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="of another log"), atomic_log(tmp_path / "new.mcap", StreamInfo("test")):
        raise LogError("of another log") from OSError(5, "Input/output error")
    assert not list(tmp_path.iterdir())


def test_no_log_is_made_where_there_is_no_folder(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "new.mcap"
    with pytest.raises(LogError, match="No such file") as caught, atomic_log(path, StreamInfo("test")):
        pass
    assert str(caught.value).startswith(f"{path}: ")
