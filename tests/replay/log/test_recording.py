"""Recordings in parts; disks that are full, by the kernel's word and by our own reserve."""

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from semantic_mapper.errors import LogError
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.importers.run import import_recording
from semantic_mapper.replay.log.format import LogAttachment, LogReader, LogWriter, recover
from semantic_mapper.replay.log.recording import Recording, RecordingRules
from semantic_mapper.replay.log.sequence import open_log, parts_on_disk
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import StreamInfo
from tests.replay import recordings as rec
from tests.transport import samples

INFO = StreamInfo("test", {samples.CAMERA: samples.INTRINSICS}, NYU40)
FRAME = [encode_frame(samples.make_frame(seq)) for seq in range(60)]
FRAME_BYTES = sum(map(len, FRAME[0]))


def recording(path: Path, rules: RecordingRules, **more) -> Recording:
    return Recording(path, INFO, rules, recording=more.pop("name", "one"), **more)


def write(to: Recording, numbers: range) -> None:
    for seq in numbers:
        to.write(FRAME[seq])


def frames_in(*paths: Path) -> list[int]:
    """Numbers of the frames, all of which have to be whole."""
    with open_log(paths, allow_empty=True) as log:
        found = [frame.seq for frame in log]
        assert not log.errors, log.errors
        return found


class Disk:
    """A disk of ``size`` bytes under the files that are written: takes what fits, then says that no more does."""

    def __init__(self, folder: Path, size: int, monkeypatch: pytest.MonkeyPatch, error: int = errno.ENOSPC) -> None:
        self.folder, self.size, self.error = folder, size, error
        self._write = os.write
        monkeypatch.setattr("semantic_mapper.replay.log.format.os.write", self.write)

    def free(self, folder: Path) -> int:
        return self.size - sum(file.stat().st_size for file in self.folder.iterdir())

    def write(self, fd: int, data) -> int:
        if not os.readlink(f"/proc/self/fd/{fd}").startswith(str(self.folder)):
            return self._write(fd, data)
        room = self.free(self.folder)
        if room <= 0:
            raise OSError(self.error, os.strerror(self.error))
        return self._write(fd, bytes(data)[:room])


class World:
    """What the recording believes of the disk and the clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.free: Callable[[Path], int] = lambda folder: 1 << 40
        module = "semantic_mapper.replay.log.recording"
        usage = SimpleNamespace(disk_usage=lambda folder: SimpleNamespace(free=self.free(folder)))
        monkeypatch.setattr(f"{module}.shutil", usage)
        monkeypatch.setattr(f"{module}.time", SimpleNamespace(monotonic=lambda: self.now))


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def test_parts_by_size_are_logs_by_themselves_and_one_together(tmp_path: Path) -> None:
    with_parts = recording(tmp_path / "a.mcap", RecordingRules(split_bytes=20_000))
    write(with_parts, range(40))
    with_parts.close()
    files = parts_on_disk(tmp_path / "a.mcap")
    assert list(files) == list(range(with_parts.parts)) and len(files) > 5
    alone = [frames_in(file) for file in files.values()]
    assert [seq for found in alone for seq in found] == list(range(40)) and all(alone)
    shuffled = sorted(files.values(), key=lambda file: file.name[::-1])
    assert frames_in(*shuffled) == frames_in(tmp_path) == list(range(40))
    with open_log(shuffled) as log:
        assert log.finished and not log.notices and len(log) == 40 and log.paths == list(files.values())
        assert [log.frame(n).seq for n in (39, 0, 17, 8)] == [39, 0, 17, 8]
        assert [e.seq for e, _ in log.frame_parts()] == list(range(40))
        assert [item.seq for item in log.frames_or_errors(11)] == list(range(11))  # type: ignore[union-attr]
        assert log.info == INFO and log.path == files[0]
        with pytest.raises(LogError, match="no frame 40"):
            log.frame(40)
    for file in files.values():
        assert file.stat().st_size < 20_000 + 8_000  # the index comes on top


def test_each_part_says_what_all_streams_are(tmp_path: Path) -> None:
    second = StreamInfo("test", {"right": samples.INTRINSICS}, NYU40)
    lenses = [LogAttachment("lenses.json", "application/json", data) for data in (b"left", b"left, right")]
    two = Recording(
        tmp_path / "a.mcap", INFO, RecordingRules(split_bytes=20_000), recording="two", attachments=lenses[:1]
    )
    two.announce(encode(second, sender="right"), lenses[1])
    for seq in range(20):
        write(two, range(seq, seq + 1))
        two.write(encode_frame(replace(samples.make_frame(seq), camera_id="right")))
    two.close()
    files = parts_on_disk(tmp_path / "a.mcap")
    assert len(files) > 3
    for file in files.values():
        with LogReader(file) as log:
            assert set(log.info.cameras) == {samples.CAMERA, "right"}
            assert log.attachments()["lenses.json"] == lenses[1]
            assert not log.errors


def test_parts_by_time(tmp_path: Path, world: World) -> None:
    timed = recording(tmp_path / "a.mcap", RecordingRules(split_s=2))
    for seq in range(10):
        write(timed, range(seq, seq + 1))
        world.now += 0.75
    timed.close()
    assert [frames_in(f) for f in parts_on_disk(tmp_path / "a.mcap").values()] == [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9]]


def test_parts_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    for name in ("one", "two"):
        r = recording(tmp_path / f"{name}.mcap", RecordingRules(split_bytes=20_000), name=name)
        write(r, range(20))
        r.close()
    one, two = parts_on_disk(tmp_path / "one.mcap"), parts_on_disk(tmp_path / "two.mcap")
    with LogWriter(tmp_path / "alone.mcap", INFO) as log:
        log.write_parts(FRAME[0])
    for paths, message in (
        ([one[0], two[1]], "different recordings"),
        ([one[0], tmp_path / "alone.mcap"], r"alone.mcap: was not recorded in parts"),
        ([one[1], one[1]], "same part 1"),
        ([tmp_path], r"taken for the parts of one recording.*in parts.*name its file: alone\.mcap, one-1\.mcap"),
    ):
        with pytest.raises(LogError, match=message):
            open_log(paths)
    (tmp_path / "none").mkdir()
    with pytest.raises(LogError, match="holds no log"):
        open_log(tmp_path / "none")
    with open_log([one[3], one[1]]) as log:
        assert "is part 1: what was recorded before" in log.notices[0] and "1 parts of the recording" in log.notices[1]


def test_full_disk_stops_the_recording_with_all_that_was_written(tmp_path: Path, world: World) -> None:
    stopped = recording(tmp_path / "a.mcap", RecordingRules(reserve_bytes=5_000))
    for seq in range(20):
        world.free = lambda folder, seq=seq: (10 - seq) * FRAME_BYTES
        write(stopped, range(seq, seq + 1))
    assert stopped.ended and stopped.frames + stopped.lost == 20 and stopped.frames >= 5
    assert "recording has stopped" in stopped.trouble and "the disk is full" in stopped.trouble
    world.free = lambda folder: 1 << 40
    write(stopped, range(20, 22))  # stopped is stopped
    assert stopped.lost == 22 - stopped.frames
    with LogReader(tmp_path / "a.mcap") as log:
        assert log.finished and [f.seq for f in log] == list(range(stopped.frames))
    stopped.close()


def test_ring_keeps_the_newest_and_the_reserve(tmp_path: Path, world: World) -> None:
    size, reserve = 200_000, 30_000
    left: list[int] = []

    def free(folder: Path) -> int:
        left.append(size - sum(file.stat().st_size for file in folder.iterdir()))
        return left[-1]

    world.free = free
    ring = recording(tmp_path / "a.mcap", RecordingRules(30_000, disk_full="delete-oldest", reserve_bytes=reserve))
    write(ring, range(60))
    ring.close()
    found = frames_in(tmp_path)
    assert found == list(range(60))[-len(found) :] and 8 < len(found) < 60
    assert ring.lost == 0 and ring.deleted > 0 and not ring.trouble and min(left) > reserve - 20_000
    assert 0 not in parts_on_disk(tmp_path / "a.mcap")
    with open_log(tmp_path) as log:
        assert "what was recorded before is not here" in log.notices[0]


def test_recording_pauses_where_nothing_is_left_to_delete_and_goes_on(tmp_path: Path, world: World) -> None:
    pausing = recording(tmp_path / "a.mcap", RecordingRules(1 << 20, disk_full="delete-oldest", reserve_bytes=1000))
    write(pausing, range(3))
    world.free = lambda folder: 1500
    write(pausing, range(3, 6))
    assert pausing.lost == 3 and not pausing.ended and "goes on once there is room" in pausing.trouble
    world.free, world.now = lambda folder: 1 << 30, 105.0
    write(pausing, range(6, 8))
    assert not pausing.trouble
    pausing.close()
    assert frames_in(tmp_path) == [0, 1, 2, 6, 7]


@pytest.mark.parametrize("remove", [shutil.rmtree, lambda folder: (folder / "a.mcap").unlink()], ids=["folder", "file"])
def test_disk_or_log_that_goes_away_is_reported(tmp_path: Path, remove: Callable[[Path], None]) -> None:
    (tmp_path / "disk").mkdir()
    gone = recording(tmp_path / "disk" / "a.mcap", RecordingRules())
    write(gone, range(3))
    assert not gone.gone
    remove(tmp_path / "disk")
    write(gone, range(3, 6))
    if gone.ended:
        assert (gone.frames, gone.lost) == (3, 3) and "No such file" in gone.trouble
    gone.close()
    assert gone.gone and gone.nothing_left and "whole" not in gone.trouble


@pytest.mark.parametrize("size", range(30_000, 32_600, 433))
@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EFBIG])
def test_disk_that_takes_half_a_message_damages_nothing(
    tmp_path: Path, size: int, error: int, monkeypatch: pytest.MonkeyPatch, world: World
) -> None:
    Disk(tmp_path, size, monkeypatch, error)
    stopped = recording(tmp_path / "a.mcap", RecordingRules())
    write(stopped, range(30))
    assert stopped.ended and os.strerror(error) in stopped.trouble and stopped.frames + stopped.lost == 30
    stopped.close()
    with LogReader(tmp_path / "a.mcap") as log:
        assert [f.seq for f in log] == list(range(stopped.frames)) and not log.errors
        # Fifty bytes end it properly; where not even these fit, it is as if the writer had been killed.
        assert log.finished or size - (tmp_path / "a.mcap").stat().st_size < 50


REAL_DISK = """
import sys, shutil
from pathlib import Path
from tests.replay.log.test_recording import FRAME, recording
from semantic_mapper.replay.log.recording import RecordingRules
folder, copy, policy, reserve = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4])
r = recording(folder / "a.mcap", RecordingRules(split_bytes=100_000, disk_full=policy, reserve_bytes=reserve))
for n in range(500):
    r.write(FRAME[n % 60])
r.close()
shutil.copytree(folder, copy)
print("counts", r.frames, r.lost, r.deleted)
"""


@pytest.mark.parametrize("reserve", [0, 300_000])
@pytest.mark.parametrize("policy", ["stop", "delete-oldest"])
def test_real_small_disk(tmp_path: Path, policy: str, reserve: int) -> None:
    """A file system of 1 MB in a name space of its own; what it held is copied out of it."""
    disk, copy = tmp_path / "disk", tmp_path / "copy"
    disk.mkdir()
    mount = f'mount -t tmpfs -o size=1m tmpfs {disk} && exec {sys.executable} -c "$0" {disk} {copy} {policy} {reserve}'
    words = ["unshare", "-rm", "sh", "-c", mount, REAL_DISK]
    root = Path(__file__).parents[3]
    try:
        done = subprocess.run(words, capture_output=True, text=True, cwd=root, check=False, timeout=120)
    except FileNotFoundError:
        pytest.skip("this system has no unshare")
    if "unshare:" in done.stderr or "mount:" in done.stderr:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    frames, lost, deleted = map(int, done.stdout.split("counts")[1].split())
    found, order = frames_in(copy), [n % 60 for n in range(500)]
    if policy == "stop":
        assert found == order[:frames] and lost == 500 - frames > 100 and deleted == 0
    else:
        assert found == order[-len(found) :] and len(found) > 150 and lost == 0 and deleted > 1


def test_recorder_that_was_killed_goes_on_in_the_next_part(tmp_path: Path) -> None:
    rules = RecordingRules(split_bytes=20_000, disk_full="delete-oldest")
    first = recording(tmp_path / "a.mcap", rules)
    write(first, range(12))  # and never closed
    second = recording(tmp_path / "a.mcap", rules, goes_on=True)
    write(second, range(12, 30))
    second.close()
    assert frames_in(tmp_path) == list(range(30))
    assert second.parts == len(parts_on_disk(tmp_path / "a.mcap"))  # the ring knows of those from before


def test_recording_that_is_there_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    rules = RecordingRules(split_bytes=20_000)
    for _ in range(2):
        old = recording(tmp_path / "a.mcap", rules, overwrite=True)
        write(old, range(20))
        old.close()
    (tmp_path / "a.mcap").unlink()
    with pytest.raises(LogError, match=r"a-1\.mcap: exists already.* --overwrite, in a launch file overwrite = true"):
        recording(tmp_path / "a.mcap", rules)
    new = recording(tmp_path / "a.mcap", rules, overwrite=True)
    write(new, range(2))
    new.close()
    assert list(parts_on_disk(tmp_path / "a.mcap")) == [0]
    with pytest.raises(LogError, match="is no file"):
        recording(Path("/dev/null"), rules, overwrite=True)


def test_attachments_stay_with_a_log(tmp_path: Path) -> None:
    kept = LogAttachment("calibration.json", "application/json", b"{}")
    with LogWriter(tmp_path / "a.mcap", INFO, attachments=[kept]) as log:
        log.write_parts(FRAME[0])
    recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    data = bytearray((tmp_path / "b.mcap").read_bytes())
    with LogReader(tmp_path / "b.mcap") as reader:
        assert reader.attachments() == {"calibration.json": kept}
    data[data.index(b"calibration.json") + 45] ^= 1
    (tmp_path / "c.mcap").write_bytes(data)
    with LogReader(tmp_path / "c.mcap") as reader:
        assert reader.attachments() == {} and "is damaged" in str(reader.errors[0])


@pytest.mark.parametrize("short_of", [60, 3])
def test_log_without_room_for_its_index_is_closed_without_one(
    tmp_path: Path, short_of: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    for _ in range(2):
        with LogWriter(path, INFO, overwrite=True) as log:
            for parts in FRAME[:3]:
                log.write_parts(parts)
        with LogReader(path) as reader:
            assert reader.finished and len(reader) == 3 and not reader.errors
        Disk(tmp_path, path.stat().st_size - short_of, monkeypatch)


@pytest.mark.parametrize("room", [0, 10_000])
def test_on_a_full_disk_an_import_and_a_recovery_leave_nothing(
    tmp_path: Path, room: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, log, small = rec.make_folder(tmp_path / "kitchen"), tmp_path / "log.mcap", tmp_path / "small"
    import_recording(source, log)
    assert log.stat().st_size > 20_000
    small.mkdir()
    disk = Disk(small, room, monkeypatch)
    for make, of in ((import_recording, source), (recover, log)):
        with pytest.raises(LogError, match=r"small/new.mcap: cannot be written: No space left on device"):
            make(of, small / "new.mcap")
        assert not list(small.iterdir())
    disk.size += 3
    (small / "old.mcap").write_bytes(b"old")
    with pytest.raises(LogError, match="No space left"):
        import_recording(source, small / "old.mcap", overwrite=True)
    assert [file.read_bytes() for file in small.iterdir()] == [b"old"]  # until the new one is whole
    disk.size = 1 << 30
    recover(log, small / "new.mcap")
    assert len(frames_in(small / "new.mcap")) == 6
