"""The fused map: sparse voxel blocks with TSDF, colour and class evidence."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import ConfigError, FrameError, MapError
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.localization.places import Place, PlaceStore, shared_places
from semantic_mapper.mapping.allocation import blocks_in_band, frame_budget, make_camera
from semantic_mapper.mapping.block_grid import BLOCK_SIDE, BlockGrid
from semantic_mapper.mapping.blocks import pack_keys, unpack_keys
from semantic_mapper.mapping.changes import (
    CONFIDENCE_STEPS,
    NONE_CLEARED,
    BlockChanges,
    ClearedBlocks,
    CopiedChanges,
    Decision,
    empty_changes,
    oldest_first,
    packed_parts,
    received_parts,
)
from semantic_mapper.mapping.clearing import NO_BOUNDS, Scene, clear_in_view, depth_bounds
from semantic_mapper.mapping.fusion import SURFACE_WEIGHT, Votes, checked_depth, frame_votes, fuse_blocks, make_limits
from semantic_mapper.mapping.map_file import BlockPart, MapManifest, open_map
from semantic_mapper.mapping.map_snapshot import FrozenMap
from semantic_mapper.mapping.map_types import MapMesh, MapPoints, MapView, require_same_scale, scale_name
from semantic_mapper.mapping.merge import add_blocks, check_fit, copy_blocks, voxel_transform
from semantic_mapper.mapping.surface import (
    cast_view,
    join_meshes,
    open3d_grid,
    read_points,
    surface_voxels,
    triangle_mesh,
)
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, Int32, Int64, PosedFrame, UInt8

# One lock for all maps of a process: growth moves the memory that readers look at, and merging takes two maps at once.
_KERNEL_LOCK = threading.RLock()

BLOCKS_A_VERSION = 256  # of a map that takes over another one
MAX_STAMPS = 8192  # of frames that a map knows while it runs; of more, every second one is forgotten
POINT_FIELDS = ("xyz", "rgb", "label", "confidence", "measured")


class VoxelMap:
    """Posed depth, colour and class probabilities in; surface points, mesh, views and files out.

    Deterministic: the same frames in the same order give the same ``block_state``, bit for bit. Any thread may call it:
    calls wait for each other, and the long ones leave the GIL to others. L = len(label_set) channels of class evidence.
    ``ConfigError``: no map can be built with ``config``; ``MapError``: there is no memory.

    ``frames`` counts what is fused, ``version`` grows with every change, ``epoch`` counts how often another map has
    replaced the whole (``take_over``): blocks may be gone then. ``scale_known``: lengths are metres. ``refined`` is the
    digest of the weights that refined the map, ``places`` are views to find it again by, ``objects`` are the bytes of
    what it remembers of its things (``queries.objects``; ``add`` leaves them as they are), ``cleared`` counts voxels of
    surfaces that frames of this process saw through."""

    def __init__(self, config: VoxelMapConfig, label_set: LabelSet) -> None:
        self._limits = make_limits(config)
        self.config = config
        self.label_set = label_set
        self.frames = 0
        self.version = 0
        self.epoch = 0
        self.last_stamp_ns = 0
        self.scale_known = True
        self.refined = ""
        self.places = PlaceStore()
        self.objects = b""
        self.objects_version = 0  # ``version`` that ``objects`` are of
        self.cleared = 0
        self._stamps: list[tuple[int, int]] = []  # version and stamp of frames, of ever fewer the longer the run
        self._cleared_rows = NONE_CLEARED
        self._bounds = NO_BOUNDS  # of the last frame that cleared
        memory_bytes, blocks = int(config.memory_mb * 1e6), (config.initial_blocks, config.max_blocks)
        self._grid = BlockGrid(config.voxel_size_m, len(label_set), *blocks, memory_bytes)
        self.truncation_m = config.truncation_voxels * config.voxel_size_m

    def note_scale(self, known: bool) -> None:
        """Say whether frames to come are in metres, as their stream knows (``StreamInfo.scale_known``); a map with some
        that are not stays unknown."""
        self.scale_known = self.scale_known and known

    @property
    def block_count(self) -> int:
        """Blocks of 8^3 voxels in the map."""
        return self._grid.block_count

    @property
    def stored_blocks(self) -> int:
        """Those of them that are on disk because of ``memory_mb``."""
        return self._grid.stored_count

    def changes(self, since: int, limit: int = 0, min_weight: float = SURFACE_WEIGHT) -> BlockChanges:
        """The blocks changed after ``version`` was ``since`` (0: the whole map), in compact form.

        Those that wait longest, in whole versions (a frame; a loaded map is one version) until it is ``limit`` blocks
        or more (0 = all): who asks on with the version they got comes to the present map. Voxels of less than
        ``min_weight`` count as not observed; 1 = only what was measured. ``MapError``: ``since`` is no version of this
        map, or a bad ``limit`` or ``min_weight``."""
        with _KERNEL_LOCK:
            return self._choose_changes(since, limit, min_weight).compact()

    def copy_changes(self, since: int, limit: int = 0, min_weight: float = SURFACE_WEIGHT) -> CopiedChanges:
        """As ``changes``, but only copied here: another thread makes them compact, which is most of the work."""
        with _KERNEL_LOCK:
            chosen = self._choose_changes(since, limit, min_weight)
            return dataclasses.replace(chosen, parts=tuple(chosen.parts))

    @property
    def memory_bytes(self) -> int:
        """Bytes held for voxels and tables."""
        return self._grid.memory_bytes

    def integrate(
        self,
        frame: PosedFrame,
        depth_m: Float32,
        probabilities: Float32 | None,
        known: Bool | None = None,
        *,
        rows: Int32 | None = None,
        trust: Float32 | None = None,
        measured: bool = True,
    ) -> int:
        """Fuse one frame; returns blocks touched, 0 where the depth image holds no measurement.

        ``PoseError``, ``FrameError``, ``ShapeError``: the frame cannot be used. ``MapError``: the map would grow past
        ``max_blocks``, or the disk fails. The map is as it was; save where the disk fails amid a frame that
        ``memory_mb`` has no room for: a part of its blocks is fused then.

        Args:
            frame: Gives rgb, intrinsics (rectified) and pose; its own depth is not looked at.
            depth_m: (H, W) float32 z in metres; 0, negative, NaN or beyond ``depth_max_m`` = no measurement.
            probabilities: (H, W, L) float32, each known pixel summing to 1; None = geometry and colour alone.
            known: (H, W) bool, where ``probabilities`` mean something; None = everywhere.
            rows: (H, W) int32, which row of ``probabilities``, (K, L) then, is a pixel's; -1 = unknown.
            trust: (H, W) float32 0..1, how much of its full weight each depth and its vote count; None = 1.
            measured: Whether a sensor measured the depth; what was computed weighs less (``mapping/fusion.py``)."""
        where = f"frame seq={frame.seq} of camera '{frame.camera_id}'"
        check_pose(frame.T_world_camera, where)
        if frame.intrinsics.distorted:
            raise FrameError(f"{where}: the image is not rectified (distortion {frame.intrinsics.distortion})")
        depth, weights = checked_depth(depth_m, trust, frame.intrinsics, where)
        camera, classes = make_camera(frame.intrinsics, frame.T_world_camera), len(self.label_set)
        with _KERNEL_LOCK:
            votes = Votes(np.zeros((1, classes), np.uint16), np.zeros(depth.shape, np.int32), np.zeros_like(depth))
            if probabilities is not None:
                of_map = camera, self.config.depth_max_m, classes, where
                votes = frame_votes(depth, probabilities, known, rows, weights, *of_map)
            lengths = self.config.voxel_size_m, self.truncation_m, self.config.depth_max_m
            packed = blocks_in_band(depth, camera, *lengths, frame_budget(self.config.max_blocks))
            scene = Scene(camera, self._limits, depth, np.ascontiguousarray(frame.rgb))
            clears = measured and self.config.clear_free_space
            bounds = NO_BOUNDS
            if clears:
                bounds = self._bounds = depth_bounds(depth, self.config.depth_max_m, self._bounds)
            cleared: list[tuple[Int64, Int64]] = []
            for blocks in self.changing(packed):
                buffers = self._grid.buffers()
                gone = fuse_blocks(blocks, buffers, scene, weights, votes, measured=measured, bounds=bounds)
                cleared.append((pack_keys(buffers.keys[blocks]), gone))
            if clears:
                cleared += clear_in_view(self._grid, packed, scene, bounds, self.version)
                for keys, voxels in cleared:
                    self.cleared += int(voxels.sum())
                    some = np.flatnonzero(voxels)
                    version, stamp = np.full(len(some), self.version), np.full(len(some), frame.stamp_ns)
                    rows_cleared = ClearedBlocks(keys[some], voxels[some], version, stamp)
                    self._cleared_rows = self._cleared_rows.followed_by(rows_cleared)
            self.frames += 1
            self.last_stamp_ns = frame.stamp_ns
            if len(self._stamps) >= MAX_STAMPS:
                del self._stamps[::2]
            self._stamps.append((self.version, frame.stamp_ns))
        return len(packed)

    @contextmanager
    def locked(self) -> Iterator[BlockGrid]:
        """The storage itself, for passes that are no part of this class; other threads wait meanwhile."""
        with _KERNEL_LOCK:
            yield self._grid

    def changing(self, packed: Int64) -> Iterator[Int32]:
        """Bring blocks with unique packed keys (B,) into memory for a pass that changes them, under the lock: buffer
        indices of as many as memory has room for at a time. Together they are one new ``version``."""
        version = self.version + 1
        for blocks in self._grid.batches(packed):
            yield blocks
            self._grid.mark_changed(blocks, version)
            self.version = version

    def take_over(self, other: VoxelMap) -> None:
        """Become ``other``, of the same config and classes (else ``MapError``), all at once for other threads;
        ``other`` must not be used any more.

        All blocks count as changed, and ``epoch`` goes up. For ``changes`` with a limit, ``version`` grows by one for
        each ``BLOCKS_A_VERSION`` of them."""
        if (other.config, other.label_set) != (self.config, self.label_set):
            raise MapError("a map can only take over one of the same config and label set")
        with _KERNEL_LOCK:
            self._grid = other._grid
            self.frames, self.last_stamp_ns = other.frames, other.last_stamp_ns
            self.note_scale(other.scale_known)
            self.refined, self.places, self.objects = other.refined, other.places, other.objects or self.objects
            self.version = self._grid.mark_all_changed(self.version + 1, BLOCKS_A_VERSION)
            self.epoch += 1

    def changed_stamps(self, since: int) -> tuple[Int64, Int64]:
        """Packed keys (B,) of the blocks that have changed after a version, sorted, and stamps (B,) of the frames that
        changed each last, or of the next ones of which it is known."""
        with _KERNEL_LOCK:
            packed, versions = self._grid.versions_since(since)
            known = np.array((*self._stamps, (2**62, self.last_stamp_ns)), np.int64)
        return packed, known[np.searchsorted(known[:, 0], versions), 1]

    def points(self, min_weight: float = SURFACE_WEIGHT, *, unknown_below: float | None = None) -> MapPoints:
        """Points of the surface, at most three a voxel, in a fixed order; 1 as ``min_weight`` = only what was
        measured. ``unknown_below`` instead of the setting."""
        _check_min_weight(min_weight)
        parts: list[MapPoints] = []
        with _KERNEL_LOCK:
            for keys, blocks, grid in self._grid.tiles():
                voxels = surface_voxels(keys, blocks, grid, min_weight)
                xyz = (voxels * self.config.voxel_size_m).astype(np.float32)
                parts.append(MapPoints(xyz, *self._read(grid, voxels, unknown_below)))
        return MapPoints(*(np.concatenate([getattr(part, name) for part in parts]) for name in POINT_FIELDS))

    def mesh(self, min_weight: float = SURFACE_WEIGHT) -> MapMesh:
        """Triangle mesh of the surface by marching cubes, in a fixed order; see ``points``. Needs Open3D."""
        _check_min_weight(min_weight)
        parts: list[MapMesh] = []
        with _KERNEL_LOCK:
            for keys, _, grid in self._grid.tiles():
                vertices, faces = triangle_mesh(keys, grid, self.config.voxel_size_m, min_weight)
                read = self._read(grid, vertices.astype(np.float64) / self.config.voxel_size_m)
                parts.append(MapMesh(vertices, faces, *read))
        return parts[0] if len(parts) == 1 else join_meshes(parts)

    def to_open3d(self) -> Any:
        """A copy of the whole map as an ``open3d.t.geometry.VoxelBlockGrid`` with tsdf, weight and
        color (float32), label (uint8 id, the ignore id where unknown), and evidence and votes as they are stored.

        Open3D shows voxels of a weight above 3, unless its ``weight_threshold`` says otherwise, and averages labels
        where it resamples points. ``MapError``: the map is empty."""
        state = self.block_state()
        keys = np.asarray(state.pop("keys"), np.int32)
        if not len(keys):
            raise MapError("an empty map has no blocks to hand to Open3D; map a frame first")
        flat = {name: values.reshape(len(keys), -1, *values.shape[4:]) for name, values in state.items()}
        return open3d_grid(keys, self.config.voxel_size_m, **flat, label=self.changes(0, min_weight=1e-9).label)

    def ray_cast(self, T_world_camera: Float64, intrinsics: CameraIntrinsics, wanted: Bool | None = None) -> MapView:
        """The map as a camera (4, 4) would see it, up to ``depth_max_m`` away; pixel centres are integers. Pixels that
        are not ``wanted`` (H, W) see nothing."""
        check_pose(T_world_camera, "ray_cast")
        camera = make_camera(intrinsics, T_world_camera)
        with _KERNEL_LOCK:
            depth_m, seen = cast_view(self._grid, camera, intrinsics, self.config, wanted)
        return MapView(depth_m, seen.rgb, self.label_set.to_ids(seen.channel), seen.confidence, seen.measured)

    def block_state(self, keys: Int32 | None = None) -> dict[str, NDArray[np.generic]]:
        """A copy of everything, or of some existing blocks (B, 3), for comparisons bit by bit; it pages nothing in.

        keys (B, 3) int32, by default in lexicographic order; tsdf, weight, votes (B, 8, 8, 8), color (B, 8, 8, 8, 3)
        float32, evidence (B, 8, 8, 8, L) uint16 (``fusion.evidence_of``); voxels in the order [z][y][x]."""
        with _KERNEL_LOCK:
            keys = self._grid.all_keys() if keys is None else keys
            values = self._grid.read(pack_keys(keys))
        cube = (len(keys), BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
        return {"keys": keys, **{name: v.reshape(*cube, *v.shape[2:]) for name, v in values._asdict().items()}}

    def save(self, path: Path, between: Callable[[], object] = lambda: None) -> None:
        """Write the map as it is now to one file (``map.npz``), whole or not at all, while other threads go on
        integrating. ``between`` is called after each ``CHUNK_BLOCKS``. ``MapError``: it cannot be written; a file from
        before is as it was."""
        self.snapshot().write(path, between)

    def snapshot(self) -> FrozenMap:
        """The map as it is now: for another thread to write, or to begin with again (``restored``)."""
        with _KERNEL_LOCK:
            manifest = MapManifest(
                config=self.config,
                label_set=self.label_set,
                frames=self.frames,
                last_stamp_ns=self.last_stamp_ns,
                scale=scale_name(self.scale_known),
                refined=self.refined,
            )
            return FrozenMap(self._grid, _KERNEL_LOCK, manifest, self.places.places, self.objects)

    @classmethod
    def restored(cls, snapshot: FrozenMap) -> VoxelMap:
        """Another map, as one was when the snapshot was made, bit for bit."""
        made = cls(snapshot.manifest.config, snapshot.manifest.label_set)
        made._begin_with(snapshot.manifest, snapshot.parts(), snapshot.places, snapshot.objects)
        return made

    @classmethod
    def received(cls, changes: BlockChanges, voxel_size_m: float, label_set: LabelSet) -> VoxelMap:
        """What changes since version 0 hold of a map, to be exported, not continued: a voxel has a vote for its class,
        if one is sure, and weight 1, or ``SURFACE_WEIGHT`` of computed depth; ``frames`` is the version."""
        least = int(changes.confidence[changes.label != label_set.ignore_id].min(initial=CONFIDENCE_STEPS))
        below = max(0.0, least - 0.5) / CONFIDENCE_STEPS  # the map's own is not sent; no class here is less sure
        config = VoxelMapConfig(voxel_size_m=voxel_size_m, max_blocks=max(1, len(changes.keys)), unknown_below=below)
        made, scale = cls(config, label_set), scale_name(changes.scale_known)
        saved = MapManifest(config=config, label_set=label_set, frames=changes.version, last_stamp_ns=0, scale=scale)
        made._begin_with(saved, received_parts(changes, label_set), (), b"")
        return made

    @classmethod
    def load(cls, path: Path, memory_mb: int | None = None, config: VoxelMapConfig | None = None) -> VoxelMap:
        """Read a saved map; it is the saved one bit for bit and can go on integrating.

        ``memory_mb`` stands in place of the saved setting; 0 = no limit. ``config``, of voxels of the same size (else
        ``ConfigError``), stands in place of all settings. ``MapError``: no such file, not a map, of another format
        version, or damaged (and what is)."""
        with open_map(path) as reader:
            saved = reader.manifest
            config = config or saved.config
            if config.voxel_size_m != saved.config.voxel_size_m:
                raise ConfigError(
                    f"{path}: was made with voxel_map.voxel_size_m = {saved.config.voxel_size_m:g} and cannot continue "
                    f"with {config.voxel_size_m:g}: leave that out"
                )
            config = config if memory_mb is None else replace(config, memory_mb=memory_mb)
            try:
                loaded = cls(config, saved.label_set)
                loaded._grid.reserve(saved.blocks)
            except (ConfigError, MapError) as error:
                raise MapError(f"{path}: cannot be used: {error}; where memory is short, give memory_mb") from error
            loaded._begin_with(saved, reader.parts(), reader.places(), reader.objects())
        return loaded

    def _begin_with(
        self, manifest: MapManifest, parts: Iterable[BlockPart], places: tuple[Place, ...], objects: bytes
    ) -> None:
        for keys, values in parts:
            with _KERNEL_LOCK:
                self._grid.mark_changed(self._grid.fill(pack_keys(keys), values), manifest.frames)
        self.frames = self.version = manifest.frames
        self.last_stamp_ns = manifest.last_stamp_ns
        self.note_scale(manifest.scale_known)
        self.refined = manifest.refined
        self.places = PlaceStore(places)
        self.objects, self.objects_version = objects, self.version

    def merged(self, other: VoxelMap, T_self_other: Float64) -> VoxelMap:
        """A new map of what both have measured, in this map's frame and with its settings; see ``add``."""
        joined = VoxelMap(self.config, self.label_set)
        joined.add(self, np.eye(4))
        joined.add(other, T_self_other)
        return joined

    def add(self, other: VoxelMap, T_self_other: Float64) -> None:
        """Add all that another map, which lies at ``T_self_other`` (4, 4) in this one, has measured; see ``merge``.

        Where voxels coincide measurements add up exactly; else those of ``other`` are interpolated. After an error of
        the disk the map holds a part of ``other``. ``MapError``: the maps do not fit each other, have places of the
        same frames, only one is in metres, or this one would grow past ``max_blocks``."""
        check_pose(T_self_other, "merge")
        check_fit(self.config, self.label_set, other.config, other.label_set)
        if self.frames:
            require_same_scale(self.scale_known, other.scale_known, "merge")
        if shared := shared_places(self.places.places, other.places.places):
            raise MapError(
                f"both maps were made with the same frames ({shared} of their places are of the same ones), which "
                "would count twice; make one map of all logs instead"
            )
        with _KERNEL_LOCK:
            version = self.version + other.frames
            if not self.block_count and (T_self_other == np.eye(4)).all():
                copy_blocks(self._grid, other._grid, version)
            else:
                transform = voxel_transform(T_self_other, self.config.voxel_size_m)
                add_blocks(self._grid, other._grid, transform, self.config.max_weight, version)
            self.version = version
            self.frames += other.frames
            self.last_stamp_ns = max(self.last_stamp_ns, other.last_stamp_ns)
            self.note_scale(other.scale_known)
            self.refined = self.refined or other.refined
            for place in other.places.places:
                moved = T_self_other @ place.T_world_camera
                self.places.add(dataclasses.replace(place, T_world_camera=moved))

    def _choose_changes(self, since: int, limit: int, min_weight: float) -> CopiedChanges:
        """The changes; their blocks are read under the lock."""
        _check_min_weight(min_weight)
        packed, changed_at = self._grid.versions_since(since)
        rows, version = oldest_first(changed_at, since, limit, self.version)
        keys, cleared = unpack_keys(packed[rows]), self._cleared_rows.between(since, version)
        versions = since, version, self.version, self.epoch
        result = empty_changes(*versions, keys, scale_known=self.scale_known, cleared=cleared)
        decision = Decision(self.config.vote_discount, self.config.unknown_below, min_weight)
        return CopiedChanges(result, packed_parts(self._grid, packed[rows]), self.label_set, decision)

    def _read(
        self, grid: BlockGrid, voxels: Float64, unknown_below: float | None = None
    ) -> tuple[UInt8, UInt8, Float32, Bool]:
        """Colour, label, confidence and whether it was measured, at points (N, 3) in voxels."""
        below = self.config.unknown_below if unknown_below is None else unknown_below
        read = read_points(voxels, grid.index, grid.buffers(), self.config.vote_discount, below)
        return read.rgb, self.label_set.to_ids(read.channel), read.confidence, read.measured


def _check_min_weight(min_weight: float) -> None:
    if not min_weight > 0:
        raise MapError(f"min_weight must be above 0 (voxels without a measurement have no surface), got {min_weight}")
