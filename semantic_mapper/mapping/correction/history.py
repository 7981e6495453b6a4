"""The frames that a map was fused from, kept on disk so that the map can be built again with better poses.

The frames lie in a private SQLite database, scratch space of one running map as in ``block_store``: nothing stays
behind, however the process ends. All of it is lossless, class probabilities in full float32: a map that is built again
with the same poses is the same map, bit for bit, and whether a history is kept has no influence on the map.
"""

from __future__ import annotations

import sqlite3
import threading
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.packing import (
    pack_color,
    pack_depth,
    pack_floats,
    pack_mask,
    unpack_color,
    unpack_depth,
    unpack_floats,
    unpack_mask,
)
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, PosedFrame

SEGMENTS = 8  # a full history lets its oldest frames go by about an eighth of what it has room for
_CACHE_KIB = 4096  # of SQLite's own pages
_PAGE_BYTES = 32768  # frames are large
_ERASED_AT_ONCE = 2  # frames that have left, for each that comes: all at once would take a second


@dataclass(frozen=True, slots=True, eq=False)
class FusedFrame:
    """What fusing a frame once more needs.

    Args:
        frame: With the pose that it was fused at; its label image is not kept.
        probabilities: (h, w, L) float32 rendered class probabilities, before they are lifted to full size.
        known: (h, w) bool.
        rendered_depth_m: (h, w) float32; looked at only where the frame has no depth, and kept only there.
        moves_by_motion, moves_by_class: (H, W) what was left out of its depth; None where it was not looked for.
    """

    frame: PosedFrame
    probabilities: Float32
    known: NDArray[np.bool_]
    rendered_depth_m: Float32
    moves_by_motion: Bool | None = None
    moves_by_class: Bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrameEntry:
    """What is known of a kept frame without reading it.

    Args:
        number: Counts kept frames; a frame's follower has the next one.
        seq, stamp_ns, camera_id, intrinsics: Of the frame.
        T_world_camera: (4, 4) float64 at which the frame is in the map.
        shape: (h, w, L) of the class probabilities.
        has_depth: Whether the frame has depth of its own.
        bytes: On disk.
        offset: Bytes of all frames that were kept before it.
        world: In which its pose came.
    """

    number: int
    seq: int
    stamp_ns: int
    camera_id: str
    intrinsics: CameraIntrinsics
    T_world_camera: Float64
    shape: tuple[int, int, int]
    has_depth: bool
    bytes: int
    offset: int
    world: int = 0


class FrameHistory:
    """Frames in the order in which they were fused; only the oldest can leave. Safe to call from several threads.

    Frames leave by segments, of an eighth of ``max_frames`` or of ``max_bytes``, whichever is reached first. So the
    last ``max_frames`` frames are always here, and at most an eighth more, as long as they have room on disk.

    Args:
        max_frames: Frames that are here at least.
        max_bytes: Room on disk, with what others keep for these frames; the last frame may go beyond it.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, max_frames: int, max_bytes: int) -> None:
        self._max_frames = max_frames
        self._max_bytes = max_bytes
        self._segment_frames = -(-max_frames // SEGMENTS)
        self._lock = threading.Lock()
        self._entries: dict[int, FrameEntry] = {}  # in order
        self._next = 0
        self._bytes = 0
        self._bytes_ever = 0
        self._erased = 0  # frames that have left have no bytes on disk below this number
        try:
            self._database = sqlite3.connect("", check_same_thread=False, isolation_level=None)
            self._database.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
            self._database.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            self._database.execute("PRAGMA journal_mode = OFF")
            self._database.execute(
                "CREATE TABLE frames (number INTEGER PRIMARY KEY, crc INTEGER, "
                "color BLOB, depth BLOB, probabilities BLOB, known BLOB, sigma BLOB, motion BLOB, class BLOB)"
            )
        except sqlite3.Error as error:
            raise MapError(
                f"no room for a history of frames on disk can be made: {error}; is TMPDIR full or read-only?"
            ) from error

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def bytes(self) -> int:
        """On disk, all frames together."""
        return self._bytes

    def is_full(self, beside: int = 0) -> bool:
        """Whether a segment has to leave before the next frame comes; ``beside`` bytes of others share the room."""
        return len(self._entries) >= self._max_frames + self._segment_frames or self._bytes + beside >= self._max_bytes

    @property
    def next_number(self) -> int:
        """Of the frame that comes next."""
        return self._next

    def is_segment(self, first: int, end: int) -> bool:
        """Whether the frames from number ``first`` to before ``end``, both here or to come, are a whole segment."""
        begin, until = self._entries.get(first), self._entries.get(end)
        if begin is None:
            return False
        size = (self._bytes_ever if until is None else until.offset) - begin.offset
        return end - first >= self._segment_frames or size >= self._max_bytes // SEGMENTS

    def entries(self) -> list[FrameEntry]:
        """All frames, oldest first."""
        with self._lock:
            return list(self._entries.values())

    def entry(self, number: int) -> FrameEntry | None:
        """A frame by its number; None where it has left or has not come yet."""
        return self._entries.get(number)

    def append(self, fused: FusedFrame) -> None:
        """Keep a frame.

        Raises:
            MapError: the disk is full or fails.
        """
        frame, number = fused.frame, self._next
        blobs = _pack(fused)
        try:
            with self._lock:
                first = next(iter(self._entries), number)
                until = min(first, self._erased + _ERASED_AT_ONCE)
                self._database.execute("DELETE FROM frames WHERE number >= ? AND number < ?", (self._erased, until))
                self._erased = until
                self._database.execute(
                    f"INSERT INTO frames VALUES (?, ?{', ?' * len(blobs)})", (number, _checksum(blobs), *blobs)
                )
        except sqlite3.Error as error:
            raise MapError(
                f"frame seq={frame.seq} cannot be put on disk: {error}; make room in the folder for temporary files "
                "(TMPDIR), or lower history.max_frames or history.max_disk_mb"
            ) from error
        entry = FrameEntry(
            number=number,
            seq=frame.seq,
            stamp_ns=frame.stamp_ns,
            camera_id=frame.camera_id,
            intrinsics=frame.intrinsics,
            T_world_camera=frame.T_world_camera.copy(),
            shape=(fused.probabilities.shape[0], fused.probabilities.shape[1], fused.probabilities.shape[2]),
            has_depth=frame.depth_m is not None,
            bytes=sum(len(blob) for blob in blobs),
            offset=self._bytes_ever,
            world=frame.world,
        )
        with self._lock:
            self._entries[number] = entry
            self._bytes += entry.bytes
            self._bytes_ever += entry.bytes
            self._next += 1

    def read(self, entry: FrameEntry, T_world_camera: Float64) -> FusedFrame:
        """A kept frame, at a pose that may be another one than before.

        Raises:
            MapError: it is not there any more, or is not what was kept.
        """
        where = f"frame seq={entry.seq} of camera '{entry.camera_id}' in the history"
        try:
            with self._lock:
                row = self._database.execute(
                    "SELECT crc, color, depth, probabilities, known, sigma, motion, class FROM frames WHERE number = ?",
                    (entry.number,),
                ).fetchone()
        except sqlite3.Error as error:
            raise MapError(f"{where} cannot be read: {error}") from error
        if row is None or _checksum(row[1:]) != row[0]:
            raise MapError(f"{where} is {'missing' if row is None else 'damaged'}; its disk fails")
        return _unpack(entry, T_world_camera, row[1:])

    def drop_before(self, number: int) -> list[FrameEntry]:
        """Forget the frames before this number and give their room on disk to the next ones; returns them."""
        with self._lock:
            leaving = [entry for entry in self._entries.values() if entry.number < number]
            for entry in leaving:
                del self._entries[entry.number]
                self._bytes -= entry.bytes
        return leaving

    def replace(self, entries: list[FrameEntry]) -> None:
        """Put entries of the same numbers in the place of those here: their poses have changed."""
        with self._lock:
            self._entries.update((entry.number, entry) for entry in entries)

    def close(self) -> None:
        """Give the disk space back; the history is empty then and cannot be used any more."""
        with self._lock:
            self._database.close()
            self._entries.clear()
            self._bytes = 0


def _pack(fused: FusedFrame) -> tuple[bytes, ...]:
    depth = fused.frame.depth_m
    return (
        pack_color(fused.frame.rgb),
        pack_floats(fused.rendered_depth_m) if depth is None else pack_depth(depth),
        pack_floats(fused.probabilities),
        pack_mask(fused.known),
        b"" if fused.frame.depth_sigma_m is None else pack_floats(fused.frame.depth_sigma_m),
        b"" if fused.moves_by_motion is None else pack_mask(fused.moves_by_motion),
        b"" if fused.moves_by_class is None else pack_mask(fused.moves_by_class),
    )


def _unpack(entry: FrameEntry, T_world_camera: Float64, blobs: tuple[bytes, ...]) -> FusedFrame:
    color, depth, probabilities, known, sigma, motion, by_class = blobs
    height, width = entry.intrinsics.height, entry.intrinsics.width
    coarse = entry.shape[:2]
    return FusedFrame(
        frame=PosedFrame(
            stamp_ns=entry.stamp_ns,
            seq=entry.seq,
            camera_id=entry.camera_id,
            rgb=unpack_color(color, height, width),
            depth_m=unpack_depth(depth, height, width) if entry.has_depth else None,
            label=None,
            intrinsics=entry.intrinsics,
            T_world_camera=T_world_camera,
            depth_sigma_m=unpack_floats(sigma, (height, width)) if sigma else None,
            world=entry.world,
        ),
        probabilities=unpack_floats(probabilities, entry.shape),
        known=unpack_mask(known, *coarse),
        rendered_depth_m=np.zeros(coarse, np.float32) if entry.has_depth else unpack_floats(depth, coarse),
        moves_by_motion=unpack_mask(motion, height, width) if motion else None,
        moves_by_class=unpack_mask(by_class, height, width) if by_class else None,
    )


def _checksum(blobs: tuple[bytes, ...]) -> int:
    crc = 0
    for blob in blobs:
        crc = zlib.crc32(blob, crc)
    return crc
