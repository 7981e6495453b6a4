"""Queries on a map in tiles (``mapping.files.tiles``): only the tiles that an answer needs are in memory.

Answers are those of the whole map. ``nearest`` goes from tile to tile in the order of the least distance that the
manifest leaves for the class, and stops when none can be nearer. ``at`` reads the tiles round the point. ``instances``
reads one tile after the other and keeps the surface voxels of things, about 60 bytes each.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.mapping.files.tiles import (
    ClassExtent,
    Corner,
    TileIndex,
    TileManifest,
    TileRow,
    TileSurface,
    check_tile,
    inside,
    load_tiles,
    read_tiles,
    tile_digest,
)
from semantic_mapper.mapping.map_scale import require_metres
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.storage.block_index import make_block_index, unpack_keys
from semantic_mapper.mapping.storage.changes import CONFIDENCE_STEPS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.checks import as_numbers, check_direction, check_point, check_points
from semantic_mapper.queries.instances import MIN_VOXELS, Instance, describe_thing, find_components
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import (
    RADIUS_VOXELS,
    NearestSurface,
    PointAnswers,
    at,
    confidence_steps,
    nearer_surface,
)
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.queries.surface import ClassSurface, SurfaceVoxels, class_surface, surface_points, surface_voxels
from semantic_mapper.types import Bool, Float64, Int64

CACHED_TILES = 8  # 20 MB each, of a furnished building
MAX_SURFACE = 50_000_000  # surface voxels in memory at a time; 3 GB

Fetch = Callable[[TileRow], AbstractContextManager[Path]]


class _Tile(NamedTuple):
    """A tile in memory: with its border, and what is inside alone, with the border as its neighbours."""

    whole: MapSnapshot
    own: MapSnapshot


class _Things(NamedTuple):
    """Surface voxels of things: blocks that have some, sorted, and whether a sensor measured each voxel."""

    surface: ClassSurface
    measured: Bool


class TiledMap:
    """A merged map in tiles. Safe to use from several threads, which wait for each other's tiles.

    Args:
        manifest: Of the tiles.
        fetch: Gives the file of a tile for as long as it is read.
        cached: Tiles in memory at a time; at least 1.
    """

    def __init__(self, manifest: TileManifest, fetch: Fetch, cached: int = CACHED_TILES) -> None:
        self.manifest = manifest
        self.loads = 0  # tiles read so far
        self._fetch = fetch
        self._cached = cached
        self._tiles: OrderedDict[TileIndex, _Tile] = OrderedDict()
        self._rows = {row.index: row for row in manifest.tiles}
        self._lock = threading.Lock()
        config = manifest.config
        nothing = MapMirror(config.voxel_size_m, config.truncation_voxels, manifest.label_set).snapshot()
        self._nothing = replace(nothing, version=manifest.frames, scale_known=manifest.scale_known)

    @classmethod
    def open(cls, folder: Path) -> TiledMap:
        """Tiles in a local folder.

        Raises:
            MapError: their manifest is missing or damaged.
        """
        return cls(read_tiles(folder), lambda row: nullcontext(_there(folder / row.file)))

    def nearest(self, class_name: str, point: ArrayLike, min_confidence: float = 0.0) -> NearestSurface | None:
        """As ``queries.nearest.nearest``; loads only tiles whose surface of the class may be nearer than what is found.

        Raises:
            LabelError, MapError: see there; or a tile is damaged.
        """
        class_id = self.manifest.label_set.id_of(class_name)
        p = check_point(point, self._nothing)
        least = confidence_steps(min_confidence)
        found, hit = np.array((0.0, 0.0, 0.0, np.inf)), None
        for bound, index in sorted(self._bounds(class_name, p, least)):
            if bound > found[3]:
                break
            hit = nearer_surface(self._tile(index).own, p, class_id, least, found) or hit
        return hit

    def at(self, points: ArrayLike, radius_m: float | None = None) -> PointAnswers:
        """As ``queries.nearest.at``; loads the tiles within the radius of each point, one point after the other.

        Raises:
            MapError: see there; or a tile is damaged.
        """
        nowhere = at(self._nothing, points, radius_m)
        p = check_points(points, self._nothing)
        reach = RADIUS_VOXELS if radius_m is None else radius_m / self._nothing.voxel_size_m
        metres = as_numbers(points, "points")
        found = [at(self._around(q, reach + 1), [metres[n]], radius_m) for n, q in enumerate(p)]
        if not found:
            return nowhere
        names = ("label", "confidence", "distance_m", "state", "measured")
        return PointAnswers(*(np.concatenate([getattr(one, name) for one in found]) for name in names))

    def instances(
        self,
        stuff: Collection[str] = STUFF_NAMES,
        min_voxels: int = MIN_VOXELS,
        up: ArrayLike = (0.0, 0.0, 1.0),
    ) -> tuple[Instance, ...]:
        """The things of the map, as the first update of an ``InstanceTracker`` finds them; pieces join across tiles.

        Args:
            stuff, min_voxels, up: See there.

        Raises:
            MapError: lengths are not metres, the things have too much surface to be in memory, or a tile is damaged.
        """
        manifest, labels = self.manifest, self.manifest.label_set
        require_metres(manifest.scale_known, "instances")
        upright = check_direction(up, "up")
        ids = labels.thing_ids(frozenset(stuff))
        names = {labels.names[labels.ids.index(i)] for i in ids}
        rows = [row for row in manifest.tiles if names & row.surface.classes.keys()]
        self._check_size(sum(row.surface.classes[n].voxels for row in rows for n in names & row.surface.classes.keys()))
        wanted = np.zeros(256, np.bool_)
        wanted[list(ids)] = True
        surface, measured = _joined([_things(self._tile(row.index), wanted) for row in rows])
        components = find_components(surface, min_voxels)
        row = np.repeat(np.arange(len(surface.packed)), np.diff(surface.start))
        parts = np.split(components.order, components.ends[:-1]) if len(components.ends) else []
        size = self._nothing.voxel_size_m
        return tuple(
            describe_thing(number, labels, size, upright, surface, row, part, measured[part])
            for number, part in enumerate(parts, start=1)
        )

    def points(self) -> MapPoints:
        """Surface points of the whole map, one a surface voxel, in the order of ``queries.surface``.

        Raises:
            MapError: there are too many to be in memory, or a tile is damaged.
        """
        self._check_size(sum(row.surface.voxels for row in self.manifest.tiles))
        packed: list[Int64] = []
        parts: list[MapPoints] = []
        for row in self.manifest.tiles:
            tile = self._tile(row.index).own
            surface = surface_voxels(tile)
            packed.append(tile.packed[surface.row])
            parts.append(surface_points(tile, surface))
        if not parts:
            none = SurfaceVoxels(np.empty(0, np.int32), np.empty(0, np.int32), np.empty((0, 3)))
            return surface_points(self._nothing, none)
        order = np.argsort(np.concatenate(packed), kind="stable")
        names = ("xyz", "rgb", "label", "confidence", "measured")
        return MapPoints(*(np.concatenate([getattr(part, name) for part in parts])[order] for name in names))

    def load(self) -> VoxelMap:
        """The whole map, in memory.

        Raises:
            MapError: it is too large, or a tile is damaged; see ``load_tiles``.
        """
        with ExitStack() as stack:
            files = (stack.enter_context(self._fetch(row)) for row in self.manifest.tiles)
            return load_tiles(self.manifest, files)

    def _bounds(self, class_name: str, p: Float64, least: int) -> Iterator[tuple[float, TileIndex]]:
        """Tiles with surface of a class, and the square of the least distance that it may have, in voxels."""
        for row in self.manifest.tiles:
            extent = row.surface.classes.get(class_name)
            if extent is None or extent.most_sure * CONFIDENCE_STEPS < least - 0.5:
                continue
            gap = np.maximum(np.maximum(np.array(extent.lower) - p, p - np.array(extent.upper)), 0.0)
            yield float(gap @ gap) * (1 - 1e-12), row.index  # less than what rounding makes of the distance itself

    def _around(self, p: Float64, reach: float) -> MapSnapshot:
        """The blocks within ``reach`` of a point, both in voxels, and those next to them."""
        edge = self.manifest.edge_blocks
        first, last = (np.floor((p + side * reach) / 8).astype(np.int64) for side in (-1, 1))
        low, high = first // edge, last // edge
        packed: list[Int64] = []
        voxels: list[tuple[Any, ...]] = []
        for step in np.ndindex(*(high - low + 1).tolist()):
            x, y, z = (low + step).tolist()
            if (x, y, z) not in self._rows:
                continue
            tile = self._tile((x, y, z)).whole
            near = np.flatnonzero(((tile.keys >= first - 1) & (tile.keys <= last + 1)).all(axis=1))
            packed.append(tile.packed[near])
            voxels.append(tuple(values[tile.slots[near]] for values in tile.voxels))
        keys, chosen = np.unique(np.concatenate([*packed, np.empty(0, np.int64)]), return_index=True)
        if not len(keys):
            return self._nothing
        slots, none = np.arange(len(keys), dtype=np.int32), np.zeros(len(keys), np.int64)
        return replace(
            self._nothing,
            packed=keys,
            slots=slots,
            serials=none,
            versions=none,
            index=make_block_index(unpack_keys(keys), slots),
            voxels=BlockVoxels(*(np.concatenate(values)[chosen] for values in zip(*voxels, strict=True))),
        )

    def _tile(self, index: TileIndex) -> _Tile:
        with self._lock:
            tile = self._tiles.pop(index, None)
            if tile is None:
                while len(self._tiles) >= self._cached:
                    self._tiles.popitem(last=False)
                row = self._rows[index]
                with self._fetch(row) as path:
                    check_tile(row, tile_digest(path))
                    tile = _split(MapMirror.load(path).snapshot(), index, self.manifest.edge_blocks)
                self.loads += 1
            self._tiles[index] = tile
            return tile

    def _check_size(self, voxels: int) -> None:
        if voxels > MAX_SURFACE:
            raise MapError(
                f"{voxels:,} surface voxels are more than are held in memory at a time ({MAX_SURFACE:,}); ask single "
                "tiles, each of which is a map: `semantic-mapper query STORE/tiles/NAME.npz ...`"
            )


def _there(file: Path) -> Path:
    if not file.is_file():
        raise MapError(f"{file}: this tile is missing; `fleet merge` of the same maps makes it again")
    return file


def describe_tile(tile: VoxelMap, index: TileIndex, edge_blocks: int) -> tuple[int, TileSurface]:
    """Blocks inside a tile, and their surface, for its row in the manifest.

    Args:
        tile: Of ``fuse_pieces``.
        index: Of the tile.
        edge_blocks: Its edge.
    """
    snapshot = _split(MapMirror.of(tile).snapshot(), index, edge_blocks).own
    surface = surface_voxels(snapshot)
    if not len(surface.row):
        return snapshot.block_count, TileSurface()
    slots, voxel = snapshot.slots[surface.row].astype(np.int64), surface.voxel.astype(np.int64)
    label, confidence = (a[slots, voxel] for a in (snapshot.voxels.label, snapshot.voxels.confidence))
    labels: LabelSet = snapshot.label_set
    classes: dict[str, ClassExtent] = {}
    for class_id, name in zip(labels.ids, labels.names, strict=True):
        of_class = label == class_id
        if of_class.any():
            lower, upper = _corners(surface.point[of_class])
            most = float(confidence[of_class].max()) / CONFIDENCE_STEPS
            classes[name] = ClassExtent(voxels=int(of_class.sum()), most_sure=most, lower=lower, upper=upper)
    lower, upper = _corners(surface.point)
    return snapshot.block_count, TileSurface(
        voxels=len(label),
        measured=int(snapshot.measured(slots, voxel).sum()),
        without_class=int((label == labels.ignore_id).sum()),
        lower=lower,
        upper=upper,
        classes=classes,
    )


def _corners(points: Float64) -> tuple[Corner, Corner]:
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return (x0, y0, z0), (x1, y1, z1)


def _split(snapshot: MapSnapshot, index: TileIndex, edge_blocks: int) -> _Tile:
    own = inside(snapshot.keys, index, edge_blocks)
    rows = ("packed", "slots", "serials", "versions")
    return _Tile(snapshot, replace(snapshot, **{name: getattr(snapshot, name)[own] for name in rows}))


def _things(tile: _Tile, wanted: NDArray[np.bool_]) -> _Things:
    """Surface voxels of some classes inside a tile."""
    whole = tile.whole
    found = class_surface(whole, wanted)
    counts = np.diff(found.start)
    used = np.isin(whole.packed, tile.own.packed) & (counts > 0)
    row = np.repeat(np.arange(len(counts)), counts)
    kept = used[row]
    slots, voxel = whole.slots[row[kept]].astype(np.int64), found.voxel[kept]
    surface = ClassSurface(
        found.packed[used],
        found.serials[used],
        found.fresh[used],
        np.concatenate((np.zeros(1, np.int64), np.cumsum(counts[used]))),
        voxel,
        found.point[kept],
        found.label[kept],
        found.confidence[kept],
    )
    return _Things(surface, whole.measured(slots, voxel.astype(np.int64)))


def _joined(parts: Sequence[_Things]) -> _Things:
    """Of all tiles, with blocks in their order in the whole map."""
    surfaces = [part.surface for part in parts]
    if not surfaces:
        none, byte, flag = np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.bool_)
        voxel, points = np.empty(0, np.int32), np.empty((0, 3))
        return _Things(ClassSurface(none, none, flag, np.zeros(1, np.int64), voxel, points, byte, byte), flag)
    packed = np.concatenate([surface.packed for surface in surfaces])
    counts = np.concatenate([np.diff(surface.start) for surface in surfaces])
    order = np.argsort(packed)
    ends = np.cumsum(counts)
    start = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts[order])))
    # Voxel n of the result is voxel ``chosen[n]`` of the parts: those of each block stay together.
    chosen = np.repeat((ends - counts)[order] - start[:-1], counts[order]) + np.arange(int(start[-1]))

    def gather(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(surface, name) for surface in surfaces])[chosen]

    surface = ClassSurface(
        packed[order],
        np.concatenate([surface.serials for surface in surfaces])[order],
        np.concatenate([surface.fresh for surface in surfaces])[order],
        start,
        gather("voxel"),
        gather("point"),
        gather("label"),
        gather("confidence"),
    )
    return _Things(surface, np.concatenate([part.measured for part in parts])[chosen])
