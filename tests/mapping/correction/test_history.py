import sqlite3
import threading
from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.correction.history import FrameHistory, FusedFrame
from tests.mapping.rendered_views import INTRINSICS, frame

CLASSES = 5
COARSE = (30, 40)


def some_depth(kind: str, rng: np.random.Generator) -> np.ndarray | None:
    size = (INTRINSICS.height, INTRINSICS.width)
    if kind == "none":
        return None
    if kind == "millimetres":
        return (rng.integers(0, 9000, size).astype(np.uint16) / np.float32(1000)).astype(np.float32)
    depth = rng.uniform(-1, 7, size).astype(np.float32)
    depth[::7] = 0
    if kind == "odd":
        depth[0, :5] = np.nan, np.inf, -np.inf, -0.0, 1e-42
    return depth


def fused(seq: int, depth: str = "float", camera_id: str = "test") -> FusedFrame:
    rng = np.random.default_rng(seq)
    size = (INTRINSICS.height, INTRINSICS.width)
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(size=3)
    noisy = replace(
        frame(pose, seq=seq),
        rgb=rng.integers(0, 256, (*size, 3), dtype=np.uint8),
        depth_m=some_depth(depth, rng),
        camera_id=camera_id,
    )
    probabilities = rng.dirichlet(np.ones(CLASSES), COARSE).astype(np.float32)
    return FusedFrame(noisy, probabilities, rng.random(COARSE) < 0.7, rng.random(COARSE).astype(np.float32))


def bits(array: np.ndarray) -> tuple[tuple[int, ...], str, bytes]:
    return array.shape, array.dtype.str, array.tobytes()


@pytest.mark.parametrize("depth", ["float", "millimetres", "odd", "none"])
def test_a_frame_comes_back_equal_to_the_bit(depth: str):
    history, before = FrameHistory(10, 10**9), fused(3, depth)
    history.append(before)
    (entry,) = history.entries()
    back = history.read(entry, entry.T_world_camera)
    assert bits(back.frame.rgb) == bits(before.frame.rgb)
    assert bits(back.probabilities) == bits(before.probabilities) and bits(back.known) == bits(before.known)
    if before.frame.depth_m is None:
        assert back.frame.depth_m is None and bits(back.rendered_depth_m) == bits(before.rendered_depth_m)
    else:
        assert back.frame.depth_m is not None and bits(back.frame.depth_m) == bits(before.frame.depth_m)
    assert bits(back.frame.T_world_camera) == bits(before.frame.T_world_camera)
    for name in ("seq", "stamp_ns", "camera_id", "intrinsics"):
        assert getattr(back.frame, name) == getattr(before.frame, name)


def test_sensor_units_take_less_room_than_floats():
    floats, units = FrameHistory(10, 10**9), FrameHistory(10, 10**9)
    floats.append(fused(1, "float"))
    units.append(fused(1, "millimetres"))
    pixels = INTRINSICS.width * INTRINSICS.height
    assert floats.bytes - units.bytes > pixels


def test_frames_leave_oldest_first_and_their_bytes_go_when_others_come():
    history = FrameHistory(3, 10**9)
    for seq in range(3):
        assert not history.is_full()
        history.append(fused(seq))
    assert not history.is_full(), "3 are to be kept, so the first may leave once there are 4"
    history.append(fused(3, camera_id="other"))
    assert history.is_full() and [e.seq for e in history.entries()] == [0, 1, 2, 3]
    size = history.bytes
    first = history.entries()[0]
    assert [e.number for e in history.drop_before(1)] == [0]
    assert [e.number for e in history.entries()] == [1, 2, 3] and history.bytes == size - first.bytes
    last = history.entry(3)
    assert history.entry(0) is None and last is not None and (last.camera_id, last.stamp_ns) == ("other", 1003)
    assert not history.is_full() and history.next_number == 4
    history.append(fused(4))
    with pytest.raises(MapError, match="seq=0 of camera 'test' in the history is missing"):
        history.read(first, first.T_world_camera)


def test_room_on_disk_is_a_bound_too():
    history = FrameHistory(1000, 300_000)
    while not history.is_full():
        history.append(fused(len(history)))
    each = history.entries()[0].bytes
    assert len(history) == -(-300_000 // each) > 1


def test_room_on_disk_is_shared_with_what_is_kept_beside_the_frames():
    history = FrameHistory(1000, 300_000)
    history.append(fused(0))
    left = 300_000 - history.bytes
    assert not history.is_full(left - 1) and history.is_full(left)


def test_a_segment_is_an_eighth_of_the_frames_or_of_the_bytes_whichever_comes_first():
    frames, room = FrameHistory(20, 10**9), FrameHistory(1000, 1_200_000)
    for seq in range(8):
        frames.append(fused(seq))
        room.append(fused(seq))
    assert [frames.is_segment(2, end) for end in range(2, 9)] == [False] * 3 + [True] * 4
    sizes = np.cumsum([entry.bytes for entry in room.entries()[2:]])
    assert 50_000 < sizes[0] < sizes[1] < sizes[2] - 10_000
    assert [room.is_segment(2, 2 + n) for n in range(1, 7)] == [bool(size >= 150_000) for size in sizes]
    assert room.is_segment(2, 8) and not room.is_segment(2, 3)


def test_the_file_does_not_grow_however_many_frames_come_and_go():
    history = FrameHistory(8, 10**9)
    pages: list[int] = []
    for seq in range(60):
        if history.is_full():
            assert len(history.drop_before(history.entries()[4].number)) == 4
        history.append(fused(seq))
        pages.append(history._database.execute("PRAGMA page_count").fetchone()[0])
    assert max(pages[10:]) <= pages[7] * 1.2
    kept = history._database.execute("SELECT number FROM frames").fetchall()
    assert {e.number for e in history.entries()} <= {number for (number,) in kept} and len(kept) <= 8


@pytest.mark.parametrize("column", ["color", "depth", "probabilities", "known"])
def test_a_damaged_frame_is_told_from_a_whole_one(column: str):
    history = FrameHistory(10, 10**9)
    for seq in range(2):
        history.append(fused(seq))
    damage(history, 0, column)
    bad, good = history.entries()
    with pytest.raises(MapError, match="seq=0 of camera 'test' in the history is damaged"):
        history.read(bad, bad.T_world_camera)
    assert bits(history.read(good, good.T_world_camera).probabilities) == bits(fused(1).probabilities)


def test_a_disk_that_fails_is_named():
    history = FrameHistory(10, 10**9)
    history._database.execute("DROP TABLE frames")
    with pytest.raises(MapError, match=r"seq=4 cannot be put on disk.*TMPDIR"):
        history.append(fused(4))
    assert len(history) == 0 and history.bytes == 0


def test_one_thread_reads_while_another_one_appends():
    history = FrameHistory(100, 10**9)
    history.append(fused(0))
    wrong: list[int] = []

    def read() -> None:
        for _ in range(20):
            for entry in history.entries()[-3:]:
                if bits(history.read(entry, entry.T_world_camera).probabilities) != bits(
                    fused(entry.seq).probabilities
                ):
                    wrong.append(entry.seq)

    reader = threading.Thread(target=read)
    reader.start()
    for seq in range(1, 20):
        history.append(fused(seq))
    reader.join()
    assert not wrong and len(history) == 20


def test_a_closed_history_is_empty_and_takes_no_more():
    history = FrameHistory(10, 10**9)
    history.append(fused(0))
    history.close()
    assert len(history) == 0 and history.bytes == 0
    with pytest.raises(MapError, match="cannot be put on disk"):
        history.append(fused(1))


def damage(history: FrameHistory, number: int, column: str = "probabilities") -> None:
    """Turn one bit of a frame on disk."""
    database: sqlite3.Connection = history._database
    (blob,) = database.execute(f"SELECT {column} FROM frames WHERE number = ?", (number,)).fetchone()
    changed = bytearray(blob)
    changed[len(changed) // 2] ^= 4
    database.execute(f"UPDATE frames SET {column} = ? WHERE number = ?", (bytes(changed), number))
