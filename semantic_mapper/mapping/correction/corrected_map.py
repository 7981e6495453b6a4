"""A map that follows corrected poses: it is built again from its history, beside the one in use, and then swapped in.

A rebuild goes on in batches (``MapCorrector.advance``), between steps or from another thread. Until it is done, steps
and queries go on with the old map; frames that come meanwhile are in the history, too, so the rebuild catches up with
them. The swap comes between two steps.

Class probabilities are not rendered again. They came from source views that lie near the frame in time; a correction
changes where these are relative to each other far less than where all of them are in the world.

The history is bounded: when it is full, its oldest segment leaves (``history``). Those frames are *frozen*: what they
have put into the map stays, but no correction moves it any more. Every rebuild starts from the map as it was after the
last frozen frame. A journal (``map_journal``) has it, as it has the map at the end of each segment; a rebuild writes
one of its own, so that no frame is fused a second time for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import HistoryConfig
from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.correction.history import FrameEntry, FrameHistory, FusedFrame
from semantic_mapper.mapping.correction.pose_correction import (
    ALWAYS,
    CorrectedPoses,
    CorrectionStatus,
    PoseCorrection,
    move,
)
from semantic_mapper.mapping.correction.pose_matching import FrozenFrames, pair_poses
from semantic_mapper.mapping.keyframes import KeyframeStore
from semantic_mapper.mapping.moving_filter import MovingAgain, MovingFilter
from semantic_mapper.mapping.storage.map_journal import MapJournal
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64, PosedFrame

PORTION_WHEN_FULL = 4  # frames that a step itself rebuilds where the history is full and nothing may leave it
RESTORED_AT_ONCE = 256  # blocks of the frozen frames' map, in the time of a frame
LEAST_WRITTEN = 64  # blocks that a step, or a frame of a rebuild, puts on disk for the journal, as long as some wait;
WRITTEN_SHARE = 8  # and at least this part of them

_log = get_logger(__name__)


@dataclass(slots=True, eq=False)
class _Rebuild:
    """A map on its way."""

    voxel_map: VoxelMap
    corrections: tuple[PoseCorrection, ...]  # to be applied one after the other
    first: int  # number of the history's oldest frame
    next: int  # number of the next frame to fuse
    moving: MovingAgain
    waiting: NDArray[np.int64] | None = None  # blocks of the frozen frames' map, with which it begins; None = all
    journal: MapJournal | None = None  # from where these are there

    def place(self, entry: FrameEntry) -> Float64:
        T_world_camera = entry.T_world_camera
        for correction in self.corrections:
            T_world_camera = correction.place(entry.camera_id, entry.stamp_ns, T_world_camera, entry.world)
        return T_world_camera

    def give_up(self) -> None:
        if self.journal is not None:
            self.journal.close()


class MapCorrector:
    """The history of a map, and the rebuild that is under way, if one is.

    Args:
        config: Bounds of the history; ``max_frames`` 0 = none is kept and nothing can be corrected.
        voxel_map: In use; becomes the corrected one at a swap.
        keyframes: Move with their frames at a swap.
        fuse: Lifts a frame of the history and integrates it into the map given, without what the last argument finds.
        moving: Of the map; decides again in a rebuild.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(
        self,
        config: HistoryConfig,
        voxel_map: VoxelMap,
        keyframes: KeyframeStore,
        fuse: Callable[[VoxelMap, FusedFrame, MovingAgain], None],
        moving: MovingFilter,
    ) -> None:
        self.turn = threading.RLock()  # held by a step, and by a swap: one at a time
        self._lock = threading.RLock()  # of what is below; never taken while ``turn`` is held
        self._map = voxel_map
        self._keyframes = keyframes
        self._fuse = fuse
        self._moving = moving
        self._history = FrameHistory(config.max_frames, config.max_disk_mb * 1_000_000) if config.max_frames else None
        self._why_none = "no frames are kept; set history.max_frames in the mapper's config"
        self._rebuild: _Rebuild | None = None
        self._journal: MapJournal | None = None  # of each segment's beginning; from the first frame on
        self._journal_bytes = 0  # on disk, when last looked at
        self._frozen = FrozenFrames()
        self._lost = self._completed = self._poses = 0
        self._failure = ""
        # Of frames to come, by world, where their odometry goes on in the world before correction:
        self._motions: dict[int, Float64] = {}

    @property
    def records(self) -> bool:
        """Whether frames are kept."""
        return self._history is not None

    @property
    def status(self) -> CorrectionStatus:
        """Where corrections stand."""
        history, rebuild = self._history, self._rebuild
        return CorrectionStatus(
            running=rebuild is not None,
            done=0 if rebuild is None else rebuild.next - rebuild.first,
            total=0 if history is None else len(history),
            disk_bytes=0 if history is None else history.bytes + self._journal_bytes,
            completed=self._completed,
            poses=self._poses,
            frozen=len(self._frozen),
            lost=self._lost,
            failure=self._failure,
        )

    def motion(self, world: int) -> Float64:
        """By how much frames of a world that come are moved, (4, 4); see ``place``."""
        return self._motions.get(world, np.eye(4))

    def poses(self) -> dict[tuple[str, int], Float64]:
        """(camera_id, stamp_ns) -> T_world_camera (4, 4) of the frames that can be corrected, as the map has them."""
        entries = [] if self._history is None else self._history.entries()
        return {(e.camera_id, e.stamp_ns): e.T_world_camera.copy() for e in entries}

    def worlds(self) -> dict[tuple[str, int], int]:
        """(camera_id, stamp_ns) -> world in which its pose came, of the frames that can be corrected."""
        entries = [] if self._history is None else self._history.entries()
        return {(e.camera_id, e.stamp_ns): e.world for e in entries}

    def place(self, frame: PosedFrame) -> PosedFrame:
        """A frame that comes, at its pose in the map's world; see ``until_ns`` of ``start``."""
        pose = move(self.motion(frame.world), frame.T_world_camera)
        return frame if pose is frame.T_world_camera else replace(frame, T_world_camera=pose)

    def record(self, fused: FusedFrame) -> None:
        """Keep a frame that the map was just given. Where the disk fails, mapping goes on and correcting ends."""
        if self._history is None:
            return
        try:
            self._history.append(fused)
        except MapError as error:
            self._end_history(str(error))

    def make_room(self) -> None:
        """Let the oldest segment of a full history leave; to be called before a step, outside of ``turn``.

        During a rebuild no frame leaves, as the rebuild may still need it, but the step carries the rebuild on, so that
        it ends before the history has grown by half.
        """
        history = self._history
        if history is None:
            return
        if self._journal is None:
            try:
                self._journal = MapJournal(self._map, 0)  # now, as the map may have become a saved one
            except MapError as error:
                self._end_history(str(error))
                return
        self._write_journal()
        if not self._is_full(history) and (self._rebuild is not None or not self._segment_ends(history)):
            return
        with self._lock:
            if self._rebuild is not None and self._is_full(history):
                with suppress(MapError):  # is logged, and it is not this step that has failed
                    self.advance(PORTION_WHEN_FULL)
            if self._rebuild is not None:
                return
            try:
                with self.turn:
                    self._turn_over(history)
            except MapError as error:
                self._end_history(str(error))

    def start(self, poses: CorrectedPoses, until_ns: int | None = None) -> CorrectionStatus:
        """Begin to build the map again with corrected poses; see ``MappingPipeline.correct_poses``."""
        with self._lock:
            history = self._history
            if history is None:
                raise MapError(f"poses cannot be corrected: {self._why_none}")
            before = self._rebuild
            entries = history.entries()
            pairs = pair_poses(poses, entries, self._frozen, _own_pose if before is None else before.place)
            last_ns = max(pair.stamp_ns for pair in pairs)
            correction = PoseCorrection(pairs, last_ns if until_ns is None else until_ns)
            if before is not None:
                before.give_up()
            self._rebuild = _Rebuild(
                voxel_map=VoxelMap(self._map.config, self._map.label_set),
                corrections=(correction,) if before is None else (*before.corrections, correction),
                first=entries[0].number,
                next=entries[0].number,
                moving=self._moving.again(whole=entries[0].number == 0),
            )
            self._failure = ""
            event = "correction_begins" if before is None else "correction_begins_again"
            _log.info(event, given=len(pairs), frames=len(entries), frozen=len(self._frozen))
            return self.status

    def advance(self, max_frames: int = 1) -> bool:
        """Carry a rebuild on by this many frames and swap the maps where it has caught up; returns if it still runs.

        May be called from any thread, but not from within a step. Waits for a step that is under way before a swap.

        Raises:
            MapError: the corrected map cannot be built (too large, or a frame out of reach of any voxel, say); the
                correction is given up, the map in use stays as it is.
        """
        for _ in range(max_frames):
            with self._lock:  # let go after every frame: a step may wait for it
                if self._rebuild is None:
                    return False
                try:
                    if self._fuse_next(self._rebuild):
                        continue
                    with self.turn:
                        while self._fuse_next(self._rebuild):  # the step that was under way
                            pass
                        self._swap(self._rebuild)
                except SemanticMapperError as error:  # a frame's too: at its new pose it may be out of reach, say
                    self._rebuild.give_up()
                    self._rebuild, self._failure = None, str(error)
                    _log.error("correction_fails", reason=self._failure)
                    raise MapError(f"the correction is given up, the map stays as it is: {error}") from error
        return self._rebuild is not None

    def _fuse_next(self, rebuild: _Rebuild) -> bool:
        """Fuse the next frame of the history, or restore a part of what it begins with; False where all is done."""
        history, journal = self._history, self._journal
        if history is None or journal is None:
            raise MapError(f"poses cannot be corrected: {self._why_none}")
        if rebuild.journal is None:
            waiting = journal.oldest_keys() if rebuild.waiting is None else rebuild.waiting
            journal.restore(rebuild.voxel_map, waiting[:RESTORED_AT_ONCE])
            rebuild.waiting = waiting[RESTORED_AT_ONCE:]
            if len(rebuild.waiting):
                return True
            rebuild.journal = MapJournal(rebuild.voxel_map, rebuild.first)
        _write_some(rebuild.journal)
        entry = history.entry(rebuild.next)
        if entry is None:
            return False
        if history.is_segment(rebuild.journal.numbers[-1], entry.number):
            rebuild.journal.mark(entry.number)
        self._fuse_entry(history, entry, rebuild)
        rebuild.next += 1
        return True

    def _fuse_entry(self, history: FrameHistory, entry: FrameEntry, rebuild: _Rebuild) -> None:
        try:
            fused = history.read(entry, rebuild.place(entry))
        except MapError as error:
            self._lost += 1
            _log.error("history_frame_lost", seq=entry.seq, camera=entry.camera_id, reason=str(error))
            return
        self._fuse(rebuild.voxel_map, fused, rebuild.moving)

    def _write_journal(self) -> None:
        """Put some of what the journal holds in memory on disk, unless another thread holds what that takes."""
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self._journal is not None:
                _write_some(self._journal)
                self._journal_bytes = self._journal.disk_bytes
        except MapError as error:
            self._end_history(str(error))
        finally:
            self._lock.release()

    def _is_full(self, history: FrameHistory) -> bool:
        return history.is_full(self._journal_bytes)

    def _segment_ends(self, history: FrameHistory) -> bool:
        journal = self._journal
        return journal is not None and history.is_segment(journal.numbers[-1], history.next_number)

    def _turn_over(self, history: FrameHistory) -> None:
        """Begin the history's next segment where the last one is whole; freeze the oldest ones while it is full."""
        journal = self._journal
        if journal is None:
            return
        if self._segment_ends(history):
            journal.mark(history.next_number)
        while self._is_full(history) and len(journal.numbers) > 1:
            if not len(self._frozen):
                _log.info("history_is_full", frames=len(history), mb=round(self.status.disk_bytes / 1e6))
            self._frozen.add(history.drop_before(journal.numbers[1]))
            journal.forget_oldest()
            self._journal_bytes = journal.disk_bytes

    def _swap(self, rebuild: _Rebuild) -> None:
        assert self._history is not None
        entries = [replace(e, T_world_camera=rebuild.place(e)) for e in self._history.entries()]
        poses = {(e.camera_id, e.stamp_ns): e.T_world_camera for e in entries}
        rebuild.voxel_map.places = self._map.places
        self._map.take_over(rebuild.voxel_map)
        self._map.places.move(poses)
        moved = self._keyframes.move(poses)
        self._history.replace(entries)
        if self._journal is not None:
            self._journal.close()
        self._journal = rebuild.journal
        if self._journal is not None:
            self._journal.belong_to(self._map)
        for correction in rebuild.corrections:
            if correction.until_ns == ALWAYS:
                for world, motion in correction.last_motions.items():
                    self._motions[world] = move(motion, self.motion(world))
        rebuild.moving.adopt()
        self._completed += len(rebuild.corrections)
        self._poses += sum(len(correction) for correction in rebuild.corrections)
        self._rebuild = None
        _log.info("correction_done", frames=len(entries), keyframes_moved=moved, blocks=self._map.block_count)

    def _end_history(self, reason: str) -> None:
        """Without every frame a rebuild would lose a part of the map; better none."""
        journal, self._journal = self._journal, None
        if journal is not None:
            journal.close()
        history, self._history = self._history, None
        self._journal_bytes = 0
        self._why_none = f"the history has ended: {reason}"
        if history is not None:
            history.close()
        _log.error("history_ends", reason=reason)


def _own_pose(entry: FrameEntry) -> Float64:
    return entry.T_world_camera


def _write_some(journal: MapJournal) -> None:
    journal.write(max(LEAST_WRITTEN, journal.in_memory // WRITTEN_SHARE))
