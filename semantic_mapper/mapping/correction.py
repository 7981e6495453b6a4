"""Corrected poses of frames, as a loop closure gives them, and the map that follows them.

A frame between two given ones in time moves with both: with C_a and C_b the motions ``T_new @ T_old^-1`` of its
neighbours and s the part of the time between them, its rotation turns by slerp, and its position p goes to ``(1 - s)
C_a p + s C_b p``: blended translations would be off by (turn)^2 / 8 times the distance to the world's origin. A frame
before the first given one moves with the first, one after the last only up to ``until_ns``.

The map is built again from a snapshot of itself and the frames that were fused since, kept on disk, lossless: with the
same poses it is the same map, bit for bit. The rebuild goes on in batches, between steps or from another thread, next
to the map in use, which it replaces once it has caught up. Class probabilities are not rendered again.

Frames are kept in two halves of ``history.max_frames`` each. When the newer one is full, the older one leaves, and the
snapshot between them is the one that rebuilds begin with. So corrections reach at least one half back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from semantic_mapper.config import HistoryConfig
from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.geometry import check_pose, interpolate_pose, invert_pose, move, nearest_pose, transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.blocks import ScratchFile
from semantic_mapper.mapping.keyframes import KeyframeStore
from semantic_mapper.mapping.map_snapshot import FrozenMap
from semantic_mapper.mapping.map_types import ALWAYS, CorrectedPoses, CorrectionStatus
from semantic_mapper.mapping.rendering import RenderedView
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64, PosedFrame

FRAMES_A_STEP = 4  # of a rebuild, that a step itself fuses where the history is full

_log = get_logger(__name__)


class PosePair(NamedTuple):
    """The pose of one frame before and after, (4, 4) float64 in the map's world, and the world that it came in."""

    camera_id: str
    stamp_ns: int
    old: Float64
    new: Float64
    world: int = 0


class PoseCorrection:
    """How a correction moves frames. All cameras sit on one body; each frame moves with given poses of its own world.

    Where several cameras have the same stamp, the first by name speaks for the others. Frames later than the last pair,
    up to ``until_ns``, move with it; ``ALWAYS``: those to come as well."""

    def __init__(self, pairs: Sequence[PosePair], until_ns: int) -> None:
        self.until_ns = until_ns
        self._given: Mapping[tuple[str, int], Float64] = {(p.camera_id, p.stamp_ns): p.new for p in pairs}
        motions: dict[int, dict[int, Float64]] = {}
        for pair in sorted(pairs, key=lambda p: (p.stamp_ns, p.camera_id)):
            motions.setdefault(pair.world, {}).setdefault(pair.stamp_ns, _motion(pair))
        self._motions = {
            world: (np.array(list(of_world), np.int64), list(of_world.values())) for world, of_world in motions.items()
        }

    def __len__(self) -> int:
        """Poses given."""
        return len(self._given)

    @property
    def last_motions(self) -> dict[int, Float64]:
        """(4, 4) ``T_new @ T_old^-1`` of the last given pose of each world."""
        return {world: motions[-1] for world, (_, motions) in self._motions.items()}

    def place(self, camera_id: str, stamp_ns: int, T_world_camera: Float64, world: int = 0) -> Float64:
        """The corrected pose (4, 4) of a frame; the very one that was given, where it was."""
        given = self._given.get((camera_id, stamp_ns))
        if given is not None:
            return given
        if world not in self._motions:
            return T_world_camera
        stamps, motions = self._motions[world]
        after = int(np.searchsorted(stamps, stamp_ns))
        if after == len(stamps):
            return T_world_camera if stamp_ns > self.until_ns else move(motions[-1], T_world_camera)
        if after == 0 or stamps[after] == stamp_ns:
            return move(motions[after], T_world_camera)
        fraction = (stamp_ns - int(stamps[after - 1])) / int(stamps[after] - stamps[after - 1])
        return _between(motions[after - 1], motions[after], fraction, T_world_camera)


def _motion(pair: PosePair) -> Float64:
    """T_new @ T_old^-1, its rotation made orthonormal, so that rounding errors of poses do not add up."""
    if np.array_equal(pair.new, pair.old):
        return np.eye(4)
    motion = nearest_pose(pair.new @ invert_pose(pair.old))
    motion[:3, 3] = pair.new[:3, 3] - motion[:3, :3] @ pair.old[:3, 3]
    return motion


def _between(a: Float64, b: Float64, fraction: float, T_world_camera: Float64) -> Float64:
    if np.array_equal(a, b):
        return move(a, T_world_camera)
    out = np.eye(4)
    out[:3, :3] = interpolate_pose(a, b, fraction)[:3, :3] @ T_world_camera[:3, :3]
    position = T_world_camera[:3, 3]
    out[:3, 3] = (1 - fraction) * transform(a, position) + fraction * transform(b, position)
    return out


class _Entry(NamedTuple):
    """A frame of the history: without its images, at its pose in the map, and its bytes on disk."""

    frame: PosedFrame
    bytes: int

    @property
    def key(self) -> tuple[str, int]:
        return self.frame.camera_id, self.frame.stamp_ns


@dataclass(slots=True, eq=False)
class _Rebuild:
    """A map on its way; corrections are applied one after the other."""

    voxel_map: VoxelMap
    snapshots: list[FrozenMap]  # see ``MapCorrector``
    corrections: tuple[PoseCorrection, ...]
    done: int = 0  # frames of the history that are in it

    def place(self, frame: PosedFrame) -> Float64:
        pose = frame.T_world_camera
        for correction in self.corrections:
            pose = correction.place(frame.camera_id, frame.stamp_ns, pose, frame.world)
        return pose


class MapCorrector:
    """The history of a map, and the rebuild that is under way, if one is. Safe to call from several threads.

    ``lock`` is held by a step, by a frame of a rebuild, and where the maps are exchanged. ``voxel_map`` and
    ``keyframes`` move with their frames at the end of a rebuild. ``fuse`` integrates a frame of the history and its
    rendered view (h, w) into the map given; ``on_move`` is called when one begins, and when the map has moved."""

    def __init__(
        self,
        config: HistoryConfig,
        voxel_map: VoxelMap,
        keyframes: KeyframeStore,
        fuse: Callable[[VoxelMap, PosedFrame, RenderedView], None],
        on_move: Callable[[], None],
    ) -> None:
        self.lock = threading.RLock()
        self._config = config
        self._map = voxel_map
        self._keyframes = keyframes
        self._fuse = fuse
        self._on_move = on_move
        self._scratch = ScratchFile("frames", "lower history.max_frames or max_disk_mb") if config.max_frames else None
        self._why_none = "no frames are kept; set history.max_frames in the mapper's config"
        self._entries: list[_Entry] = []  # oldest first; the number of the first one is ``_left``
        self._left = 0  # frames that have left the history
        self._older = 0  # entries of the older half
        self._snapshots: list[FrozenMap] = []  # of the map before the older half, and between the two
        self._rebuild: _Rebuild | None = None
        self._lost = self._completed = self._poses = 0
        self._failure = ""
        # Of frames to come, by world, where their odometry goes on in the world before correction:
        self._motions: dict[int, Float64] = {}

    @property
    def records(self) -> bool:
        """Whether frames are kept."""
        return self._scratch is not None

    @property
    def status(self) -> CorrectionStatus:
        """Where corrections stand."""
        rebuild, entries = self._rebuild, self._entries
        return CorrectionStatus(
            running=rebuild is not None,
            done=0 if rebuild is None else rebuild.done,
            total=len(entries),
            disk_bytes=sum(entry.bytes for entry in entries),
            completed=self._completed,
            poses=self._poses,
            frozen=self._left,
            lost=self._lost,
            failure=self._failure,
        )

    def motion(self, world: int) -> Float64:
        """By how much frames of a world that come are moved, (4, 4); see ``place``."""
        return self._motions.get(world, np.eye(4))

    def poses(self) -> dict[tuple[str, int], Float64]:
        """(camera_id, stamp_ns) -> T_world_camera (4, 4) of the frames that can be corrected, as the map has them."""
        return {entry.key: entry.frame.T_world_camera for entry in tuple(self._entries)}

    def world_by_frame(self) -> dict[tuple[str, int], int]:
        """(camera_id, stamp_ns) -> world in which its pose came, of the frames that can be corrected."""
        return {entry.key: entry.frame.world for entry in tuple(self._entries)}

    def place(self, frame: PosedFrame) -> PosedFrame:
        """A frame that comes, at its pose in the map's world; see ``until_ns`` of ``start``."""
        pose = move(self.motion(frame.world), frame.T_world_camera)
        return frame if pose is frame.T_world_camera else replace(frame, T_world_camera=pose)

    def make_room(self) -> None:
        """Make a snapshot where a half of the history is full, before a step. During a rebuild, which may need all
        frames, none leaves, but the step continues it, so that it ends."""
        if self._scratch is None:
            return
        try:
            if not self._snapshots:  # now, as the map may have become a saved one
                self._snapshots = [self._map.snapshot()]
            if self._rebuild is not None and self._is_full:
                with suppress(MapError):  # is logged, and it is not this step that has failed
                    self.advance(FRAMES_A_STEP)
            if self._rebuild is None and self._is_full:
                self._begin_half(self._scratch)
        except SemanticMapperError as error:
            self._end_history(str(error))

    @property
    def _is_full(self) -> bool:
        newer = self._entries[self._older :]
        most = self._config.max_disk_mb * 1_000_000 / 2
        return len(newer) >= self._config.max_frames or sum(entry.bytes for entry in newer) >= most

    def _begin_half(self, scratch: ScratchFile) -> None:
        if len(self._snapshots) == 2:
            if not self._left:
                _log.info("history_is_full", frames=len(self._entries))
            scratch.drop(range(self._left, self._left + self._older))
            self._left += self._older
            self._entries = self._entries[self._older :]
            self._snapshots.pop(0).close()
        self._older = len(self._entries)
        self._snapshots.append(self._map.snapshot())

    def record(self, frame: PosedFrame, view: RenderedView) -> None:
        """Keep a frame that the map was just given, without the depth that was left out, and its view before
        upsampling. Where the disk fails, mapping goes on and correcting ends."""
        if self._scratch is None:
            return
        blob = _pack((view.probabilities, view.known, view.depth_m, frame.rgb, frame.depth_m, frame.depth_sigma_m))
        try:
            self._scratch.put([self._left + len(self._entries)], [blob])
        except MapError as error:
            self._end_history(f"frame seq={frame.seq}: {error}")
            return
        nothing = np.broadcast_to(np.uint8(0), frame.rgb.shape)  # without memory of its own
        pose = frame.T_world_camera.copy()
        kept = replace(frame, rgb=nothing, depth_m=None, label=None, depth_sigma_m=None, T_world_camera=pose)
        self._entries = [*self._entries, _Entry(kept, len(blob))]

    def start(self, poses: CorrectedPoses, until_ns: int | None = None) -> CorrectionStatus:
        """Begin to move the map with corrected poses of frames that it was fused from, as a loop closure gives them.

        The map in use stays until ``advance`` has brought the rebuild to its end. A call during a rebuild begins it
        again, with both corrections in a row. ``MapError``: no history is kept, a stamp is of no frame, or all given
        frames have left it; ``PoseError``: no rigid transform. Nothing has changed then.

        Args:
            poses: In the map's world as it is right from now on, at least one; see the head of this file.
            until_ns: Frames later than the last given one, up to this stamp, have come in the old world and move with
                it. By default none have. ``ALWAYS``: odometry goes on in the old world, and frames to come move,
                too."""
        with self.lock:
            if self._scratch is None:
                raise MapError(f"poses cannot be corrected: {self._why_none}")
            before = () if self._rebuild is None else self._rebuild.corrections
            pairs = self._pair_poses(poses)
            correction = PoseCorrection(pairs, max(p.stamp_ns for p in pairs) if until_ns is None else until_ns)
            begun = VoxelMap.restored(self._snapshots[0])
            self._give_up_rebuild()
            self._rebuild = _Rebuild(begun, [begun.snapshot()], (*before, correction))
            self._failure = ""
            self._on_move()
            _log.info("correction_begins", given=len(pairs), frames=len(self._entries), again=bool(before))
            return self.status

    def advance(self, max_frames: int = 1) -> bool:
        """Continue a rebuild by this many frames, from any thread, and exchange the maps where it has caught up;
        whether it still runs. ``MapError``: the corrected map cannot be built; it is given up, the map in use stays."""
        for _ in range(max_frames):
            with self.lock:  # let go after every frame: a step may wait for it
                rebuild = self._rebuild
                if rebuild is None:
                    return False
                try:
                    self._fuse_next(rebuild)
                    if rebuild.done == len(self._entries):
                        self._exchange(rebuild)
                except SemanticMapperError as error:  # a frame's too: at its new pose it may be out of reach, say
                    self._give_up_rebuild()
                    self._failure = str(error)
                    _log.error("correction_fails", reason=self._failure)
                    raise MapError(f"the correction is given up, the map stays as it is: {error}") from error
        return self._rebuild is not None

    def _fuse_next(self, rebuild: _Rebuild) -> None:
        row = rebuild.done
        if row < len(self._entries):
            entry = self._entries[row].frame
            assert self._scratch is not None
            try:
                (blob,) = self._scratch.get([self._left + row])
            except MapError as error:
                self._lost += 1
                _log.error("history_frame_lost", seq=entry.seq, camera=entry.camera_id, reason=str(error))
            else:
                probabilities, known, rendered, rgb, depth, sigma = _unpack(blob)
                pose = rebuild.place(entry)
                frame = replace(entry, rgb=rgb, depth_m=depth, depth_sigma_m=sigma, T_world_camera=pose)
                self._fuse(rebuild.voxel_map, frame, RenderedView(probabilities, known, rendered))
            rebuild.done += 1
        if rebuild.done == self._older and len(rebuild.snapshots) < len(self._snapshots):
            rebuild.snapshots.append(rebuild.voxel_map.snapshot())

    def _exchange(self, rebuild: _Rebuild) -> None:
        moved = [e._replace(frame=replace(e.frame, T_world_camera=rebuild.place(e.frame))) for e in self._entries]
        poses = {entry.key: entry.frame.T_world_camera for entry in moved}
        rebuild.voxel_map.places = self._map.places
        self._map.take_over(rebuild.voxel_map)
        self._map.places.move(poses)
        keyframes = self._keyframes.move(poses)
        self._entries = moved
        _close(self._snapshots)
        self._snapshots = rebuild.snapshots
        for correction in rebuild.corrections:
            if correction.until_ns == ALWAYS:
                for world, motion in correction.last_motions.items():
                    self._motions[world] = move(motion, self.motion(world))
        self._completed += len(rebuild.corrections)
        self._poses += sum(len(correction) for correction in rebuild.corrections)
        self._rebuild = None
        self._on_move()
        _log.info("correction_done", frames=len(moved), keyframes_moved=keyframes, blocks=self._map.block_count)

    def _give_up_rebuild(self) -> None:
        if self._rebuild is not None:
            _close(self._rebuild.snapshots)
        self._rebuild = None

    def _end_history(self, reason: str) -> None:
        """Without every frame a rebuild would lose a part of the map; better none."""
        self._why_none = f"the history has ended: {reason}"
        if self._rebuild is not None:
            self._failure = self._why_none
        self._give_up_rebuild()
        _close(self._snapshots)
        if self._scratch is not None:
            self._scratch.close()
        self._scratch, self._snapshots, self._entries = None, [], []
        _log.error("history_ends", reason=reason)

    def _pair_poses(self, poses: CorrectedPoses) -> list[PosePair]:
        """Old and new poses of the given frames that are in the history; raises as ``start`` does."""
        by_stamp: dict[int, list[PosedFrame]] = {}
        for entry in self._entries:
            by_stamp.setdefault(entry.frame.stamp_ns, []).append(entry.frame)
        pairs: list[PosePair] = []
        for key, new in poses.items():
            camera_id, stamp_ns = key if isinstance(key, tuple) else (None, key)
            where = f"corrected pose of stamp {stamp_ns}" + ("" if camera_id is None else f" of camera '{camera_id}'")
            check_pose(new, where)
            found = [f for f in by_stamp.get(stamp_ns, ()) if camera_id in (None, f.camera_id)]
            if len({f.camera_id for f in found}) > 1:
                names = ", ".join(sorted({f.camera_id for f in found}))
                raise MapError(f"{where}: cameras {names} have this stamp; give (camera_id, stamp_ns)")
            if found:
                frame = found[-1]
                old = frame.T_world_camera if self._rebuild is None else self._rebuild.place(frame)
                pairs.append(PosePair(frame.camera_id, stamp_ns, old, new.copy(), frame.world))
            elif not (self._left and stamp_ns < min(by_stamp, default=0)):
                nearest = min(by_stamp, key=lambda stamp: abs(stamp - stamp_ns), default="none")
                what = f"of those in the history the nearest is {nearest}"
                raise MapError(f"{where}: no frame with this stamp was mapped; {what}")
        missing = len(poses) - len(pairs)
        if not pairs:
            reason = f"all {missing} frames given have left the history; raise history.max_frames or max_disk_mb"
            raise MapError(f"no pose to correct: {reason if missing else 'none was given'}")
        if missing:
            _log.warning("correction_is_partial", given=len(poses), frozen=missing, reason="frames left the history")
        return pairs


def _close(snapshots: Sequence[FrozenMap]) -> None:
    for snapshot in snapshots:
        snapshot.close()


def _pack(arrays: Sequence[NDArray[np.generic] | None]) -> bytes:
    """Arrays as bytes, lossless: one plane for each byte of their values, as neighbouring ones are alike, and zstd."""
    packer = zstandard.ZstdCompressor(level=1)  # higher levels take several times as long for a few per cent

    def packed(array: NDArray[np.generic]) -> tuple[str, tuple[int, ...], bytes]:
        planes = np.ascontiguousarray(array).view(np.uint8).reshape(-1, array.itemsize).T
        return array.dtype.str, array.shape, packer.compress(planes.tobytes())

    return msgspec.msgpack.encode([None if array is None else packed(array) for array in arrays])


def _unpack(blob: bytes) -> list[Any]:
    arrays: list[Any] = []
    for packed in msgspec.msgpack.decode(blob, type=list[tuple[str, tuple[int, ...], bytes] | None]):
        if packed is None:
            arrays.append(None)
            continue
        dtype, shape, content = packed
        planes = np.frombuffer(zstandard.ZstdDecompressor().decompress(content), np.uint8)
        values = np.ascontiguousarray(planes.reshape(np.dtype(dtype).itemsize, -1).T)
        arrays.append(values.view(dtype).reshape(shape))
    return arrays
