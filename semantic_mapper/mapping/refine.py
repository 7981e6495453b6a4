"""Refining a map: a network that has seen many maps corrects what the votes say, and labels surface without votes.

The map is read in tiles, so that memory does not grow with it. The network sees 1.9 m far, and tiles overlap by that.
What it answers is written back as evidence that reads as exactly that. TSDF, colour and weights stay as they are, bit
for bit.

Weights that know where centres of objects are also tell which voxels are one thing (``group_things``): those that
touch, have one class, and of which the network says the same centre. Inside of a thing the centres that its voxels
point to are near each other, or drift slowly; where two things touch, they jump. Some 30 bytes for each voxel of a
thing are held until the end for that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.errors import MapError, WeightsError
from semantic_mapper.fields.nesf import (
    CELL_M,
    SMOOTHED,
    Cells,
    Near,
    Nesf,
    NesfWeights,
    SurfacePoints,
    near_cells,
    pool,
)
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.mapping.files.up_axis import find_up
from semantic_mapper.mapping.fusion.fuse import PROBABILITY_FLOOR, SURFACE_WEIGHT
from semantic_mapper.mapping.map_types import InstanceLayer, instance_layer, pack_voxels
from semantic_mapper.mapping.storage.block_grid import BLOCK_SIDE, BlockGrid
from semantic_mapper.mapping.storage.block_index import find_blocks, pack_keys
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float32, Float64, Int64

TILE_M = 8.0
OVERLAP_M = 1.9
LARGEST_VOXEL_M = 0.06  # the network knows cells of 4 cm
BAND_VOXELS = 2.0  # voxels this near the surface are filled, as near as votes reach
FILL_VOTES = 0.3  # of what is filled: later votes of frames outweigh it
FILL = 0.5
LEAST_LOG = np.float32(-30)  # of a probability that is written
ANSWERED_AT_ONCE = 65_536
AGREE_M = 0.09  # centres of neighbours that are farther apart belong to two things
LEAST_VOXELS = 60  # of a piece that stands for itself where it touches others of its class
_JOINS = 50  # rounds in which small pieces become part of larger ones
_HALF_SPHERE = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)]) - 1  # 13 of 26 neighbours
LOW_PERCENT = 1.0  # of the surface's points that lie below the floor, by noise


class UpFrame(NamedTuple):
    """Where up is: R (3, 3) turns the world so that up is z; floor_m is the floor's height there."""

    R: Float64
    floor_m: float


class SurfaceVoxels(NamedTuple):
    """Voxels near the surface in some blocks.

    Args:
        key: (N, 3) int32 block of each.
        at: (N,) int64 voxel in the block.
        points: What the network takes of them.
        core: (N,) bool: so near the surface that they make up the cells.
    """

    key: NDArray[np.int32]
    at: Int64
    points: SurfacePoints
    core: NDArray[np.bool_]

    @property
    def voxel(self) -> Int64:
        """(N, 3) coordinates in voxels."""
        return _voxels(self.key, self.at)


@dataclass(frozen=True, slots=True)
class RefineReport:
    """What became of the surface.

    Args:
        before, after: Voxels of the surface by class name; "unknown" last.
        surface: Voxels of the surface.
        relabelled: Of them, those with another class than before.
        filled: Those that had no votes and have a class now.
        voted: Whether anything had votes.
        things: Instances that were distinguished; None where the weights do not know about them.
    """

    before: dict[str, int]
    after: dict[str, int]
    surface: int
    relabelled: int
    filled: int
    voted: bool
    things: int | None = None


class _Written(NamedTuple):
    """New evidence of voxels, not yet in the map: place of their tile, and of each block, voxel, evidence and votes.

    And of the voxels that are things now: coordinates, channels, and the way to their centres, metres in the world.
    """

    column: int
    key: NDArray[np.int32]
    at: Int64
    evidence: Float32
    votes: Float32
    things: _Things


class _Things(NamedTuple):
    """Voxels (N, 3) of things, their channels (N,), and the way (N, 3) to their centres, metres along world axes."""

    voxel: Int64
    channel: Int64
    way_m: Float32


def refine(
    voxel_map: VoxelMap,
    weights: NesfWeights,
    *,
    fill: float = FILL,
    up: Float64 | None = None,
    by_name: bool = False,
    tile_m: float = TILE_M,
    on_tile: Callable[[int, int], object] = lambda done, total: None,
) -> RefineReport:
    """Refine a map in place.

    Args:
        voxel_map: Not refined yet; others may read it meanwhile, but not integrate.
        weights: Of the same classes.
        fill: Surface without votes gets a class where it is at least so likely; 1 = never.
        up: (3,) in the world; None = away from the floor.
        by_name: Take classes that have the same name in both; the probability of the others stays as it is.
        tile_m: Side of a tile.
        on_tile: Called after each with tiles done and all tiles.

    Raises:
        MapError: an empty map, one already refined, voxels over 6 cm, lengths that are not metres, or no up is found.
        WeightsError: weights of other classes.
    """
    check_refinable(voxel_map)
    shared = shared_classes(voxel_map.label_set, weights.model.label_set, by_name=by_name)
    frame = up_frame(voxel_map, up)
    counts = _Counts(len(voxel_map.label_set))
    waiting: deque[_Written] = deque()
    things: list[_Things] = []
    tiles = list(_tiles(voxel_map, tile_m))
    for n, (column, low, high) in enumerate(tiles):
        while waiting and waiting[0].column < column - 1:  # no later tile reads them
            _write(voxel_map, waiting.popleft())
        voxels = surface_voxels(voxel_map, frame, low - _overlap(voxel_map), high + _overlap(voxel_map))
        own = np.asarray(((voxels.key >= low) & (voxels.key < high)).all(axis=1), np.bool_)
        if voxels.core.any() and own.any():
            refined = _refined(voxel_map, weights.model, voxels, own, shared, fill, counts)
            things.append(refined.things._replace(way_m=refined.things.way_m @ frame.R.astype(np.float32)))
            waiting.append(refined._replace(column=column))
        on_tile(n + 1, len(tiles))
    for written in waiting:
        _write(voxel_map, written)
    voxel_map.refined = weights.digest
    report = counts.report(voxel_map.label_set)
    if not weights.model.config.centres or not things:
        return report
    layer = _layer(things, voxel_map.config.voxel_size_m)
    voxel_map.instances = layer
    return replace(report, things=int(layer.number.max(initial=-1)) + 1)


def _layer(things: Sequence[_Things], voxel_m: float) -> InstanceLayer:
    voxel, channel, way = (np.concatenate(parts) for parts in zip(*things, strict=True))
    return instance_layer(voxel, group_things(voxel, channel, way, voxel_m))


def check_refinable(voxel_map: VoxelMap) -> None:
    """Refuse maps that the network cannot refine.

    Raises:
        MapError: says why.
    """
    if not voxel_map.block_count:
        raise MapError("an empty map has nothing to refine; map a frame first")
    if voxel_map.refined:
        how = (
            "its votes were smoothed"
            if voxel_map.refined == SMOOTHED
            else f"weights of digest {voxel_map.refined[:12]}"
        )
        raise MapError(f"the map is refined already ({how}); refine the map that it was made from")
    if voxel_map.config.voxel_size_m > LARGEST_VOXEL_M:
        raise MapError(
            f"voxels of {voxel_map.config.voxel_size_m * 100:g} cm are too coarse to refine (at most "
            f"{LARGEST_VOXEL_M * 100:g} cm); replay the log with a smaller --voxel-size"
        )
    if not voxel_map.scale_known:
        raise MapError("the map's lengths are not metres, which the network learned in; import the film with --scale")


def shared_classes(mine: LabelSet, theirs: LabelSet, *, by_name: bool) -> tuple[Int64, Int64]:
    """Channels (S,) of the map and of the network that mean the same class.

    Raises:
        WeightsError: other classes, and not ``by_name``; or none has the same name.
    """
    if mine == theirs:
        return np.arange(len(mine)), np.arange(len(mine))
    pairs = [(mine.names.index(name), n) for n, name in enumerate(theirs.names) if name in mine.names]
    sets = f"the map has '{mine.name}' ({', '.join(mine.names)}), they have '{theirs.name}' ({', '.join(theirs.names)})"
    if not by_name:
        raise WeightsError(
            f"weights of other classes than the map: {sets}. --by-name takes the {len(pairs)} that both name alike"
        )
    if not pairs:
        raise WeightsError(f"weights and map name no class alike: {sets}; train with labels of the map's classes")
    map_channels, net_channels = np.array(pairs).T
    return map_channels, net_channels


def up_frame(voxel_map: VoxelMap, up: Float64 | None = None) -> UpFrame:
    """Which way is up, and where the floor is: nearly the lowest surface.

    Raises:
        MapError: the map has no surface, or ``up`` is None and cannot be found.
    """
    points = voxel_map.points()
    if not len(points.xyz):
        raise MapError("the map has no surface to refine")
    R = turn_onto(find_up(points, voxel_map.label_set) if up is None else up, np.array((0.0, 0.0, 1.0)))
    return UpFrame(R, float(np.percentile(points.xyz @ R[2].astype(np.float32), LOW_PERCENT)))


def surface_voxels(voxel_map: VoxelMap, frame: UpFrame, low: Int64, high: Int64) -> SurfaceVoxels:
    """Voxels near the surface in the blocks from ``low`` (3,) to before ``high`` (3,)."""
    config = voxel_map.config
    with voxel_map.locked() as whole:
        keys = whole.keys_between(low, high - 1)
        grid = whole.holding(pack_keys(keys))
        buffers, blocks = grid.buffers(), find_blocks(grid.index, pack_keys(keys))
        weight, sdf = buffers.weight[blocks], np.abs(buffers.tsdf[blocks]) * config.truncation_voxels  # in voxels
        near = (weight >= SURFACE_WEIGHT) & (sdf <= BAND_VOXELS)
        row, at = np.nonzero(near | ((buffers.votes[blocks] > 0) & (weight > 0)))
        core = near[row, at] & (sdf[row, at] * config.voxel_size_m <= max(CELL_M / 2, config.voxel_size_m))
        rise = _gradients(grid, keys, blocks, row, at) @ frame.R[2].astype(np.float32)
        color, votes = buffers.color[blocks[row], at], buffers.votes[blocks[row], at]
        log_p = _log_probabilities(buffers.evidence[blocks[row], at], votes, config.vote_discount)
    xyz = _voxels(keys[row], at) * config.voxel_size_m @ frame.R.T
    cell_m = max(CELL_M, config.voxel_size_m)
    points = SurfacePoints(
        xyz=((xyz + config.voxel_size_m / 2) / cell_m).astype(np.float32),
        rise=rise,
        height_m=(xyz[:, 2] - frame.floor_m).astype(np.float32),
        rgb=color / np.float32(255),
        log_p=log_p,
        votes=votes,
    )
    return SurfaceVoxels(keys[row], at, points, core)


def evidence_of(log_p: Float32, votes: Float32, vote_discount: float) -> Float32:
    """Evidence (N, L) that reads as log-probabilities (N, L) of voxels with ``votes`` (N,)."""
    return (log_p * (votes / _effective(votes, vote_discount))[:, None]).astype(np.float32)


class _Counts:
    """Voxels of the surface by channel, before and after; -1 = unknown."""

    def __init__(self, classes: int) -> None:
        self.before, self.after = np.zeros(classes + 1, np.int64), np.zeros(classes + 1, np.int64)
        self.relabelled = self.filled = self.voted = 0

    def add(self, before: Int64, after: Int64) -> None:
        size = len(self.before)
        self.before += np.bincount(before % size, minlength=size)
        self.after += np.bincount(after % size, minlength=size)
        self.relabelled += int(((before >= 0) & (after != before)).sum())
        self.filled += int(((before < 0) & (after >= 0)).sum())
        self.voted += int((before >= 0).sum())

    def report(self, label_set: LabelSet) -> RefineReport:
        names = (*label_set.names, "unknown")
        before, after = (dict(zip(names, map(int, counts), strict=True)) for counts in (self.before, self.after))
        return RefineReport(before, after, sum(before.values()), self.relabelled, self.filled, self.voted > 0)


def _refined(
    voxel_map: VoxelMap,
    model: Nesf,
    voxels: SurfaceVoxels,
    own: NDArray[np.bool_],
    shared: tuple[Int64, Int64],
    fill: float,
    counts: _Counts,
) -> _Written:
    """New evidence of the ``own`` voxels of a tile."""
    mine, theirs = shared
    points = voxels.points
    known = np.full((len(own), len(model.label_set)), 0, np.float32)
    voted = points.votes > 0
    if len(theirs) < len(model.label_set):
        known[voted] = np.log(PROBABILITY_FLOOR)
    known[:, theirs] = np.where(voted[:, None], points.log_p[:, mine], 0)
    cells = pool(points._replace(log_p=known).rows(voxels.core))
    near = near_cells(points.xyz[own], cells.cells)
    before = points.log_p[own]
    with torch.inference_mode():
        answers = _answers(model, cells, near, torch.from_numpy(known[own]), torch.from_numpy(theirs))
    said, way = (part.numpy() for part in answers)
    voted, reached = voted[own], (near.weights.sum(1) > 0.5).numpy()
    # What the classes have together that the network does not know stays; the rest it shares out.
    together = np.zeros((len(said), 1), np.float32)
    if len(mine) < before.shape[1]:
        together[voted, 0] = np.log(np.exp(before[np.ix_(voted, mine)]).sum(axis=1) + np.float32(1e-9))
    after = before.copy()
    after[:, mine] = together + said
    after[np.ix_(~voted, np.setdiff1d(np.arange(before.shape[1]), mine))] = np.log(PROBABILITY_FLOOR)
    after = np.maximum(after, LEAST_LOG)
    filled = ~voted & reached & (np.exp(said.max(axis=1)) >= fill) & (fill < 1)
    changed = (voted & reached) | filled
    votes = np.where(voted, points.votes[own], np.float32(FILL_VOTES))[changed]
    core = voxels.core[own]
    old = np.where(voted, before.argmax(axis=1), -1)
    new = np.where(changed, after.argmax(axis=1), old)
    counts.add(old[core], new[core])
    evidence = evidence_of(after[changed], votes, voxel_map.config.vote_discount)
    is_thing = np.append(np.isin(voxel_map.label_set.ids, voxel_map.label_set.thing_ids(STUFF_NAMES)), [False])
    things = np.flatnonzero(core & is_thing[new])
    found = _Things(voxels.voxel[own][things], new[things], way[things])
    return _Written(0, voxels.key[own][changed], voxels.at[own][changed], evidence, votes, found)


def _answers(
    model: Nesf, cells: Cells, near: Near, log_p: torch.Tensor, channels: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probabilities (N, S) of some channels at points, and the way (N, 3) to the centre of what they belong to."""
    answer = model(cells)
    parts: list[torch.Tensor] = []
    ways: list[torch.Tensor] = []
    for start in range(0, len(log_p), ANSWERED_AT_ONCE):
        rows = slice(start, start + ANSWERED_AT_ONCE)
        logits, way = model.read(answer, Near(near.rows[rows], near.weights[rows]), log_p[rows])
        parts.append(torch.log_softmax(logits[:, channels] / model.temperature, dim=1))
        ways.append(way)
    return torch.cat(parts), torch.cat(ways)


def _write(voxel_map: VoxelMap, written: _Written) -> None:
    packed, row = np.unique(pack_keys(written.key), return_inverse=True)
    with voxel_map.locked() as grid:
        for blocks in voxel_map.changing(packed):
            buffers = grid.buffers()
            place = np.full(len(packed), -1, np.int64)
            place[np.searchsorted(packed, pack_keys(buffers.keys[blocks]))] = blocks
            here = place[row] >= 0
            where = place[row][here], written.at[here]
            buffers.evidence[where] = written.evidence[here]
            buffers.votes[where] = written.votes[here]


def _tiles(voxel_map: VoxelMap, tile_m: float) -> Iterator[tuple[int, Int64, Int64]]:
    """Number along x, first block and end of boxes that together hold all blocks, in the order of x."""
    with voxel_map.locked() as grid:
        keys = grid.all_keys().astype(np.int64)
    low, high = keys.min(axis=0), keys.max(axis=0) + 1
    most = max(1, round(tile_m / (BLOCK_SIDE * voxel_map.config.voxel_size_m)))
    count = -(-(high - low) // most)
    side = -(-(high - low) // count)
    for place in np.ndindex(*count):
        start = low + side * place
        end = np.minimum(start + side, high)
        if ((keys >= start) & (keys < end)).all(axis=1).any():
            yield place[0], start, end


def _overlap(voxel_map: VoxelMap) -> int:
    return int(np.ceil(OVERLAP_M / (BLOCK_SIDE * voxel_map.config.voxel_size_m)))


def _voxels(key: NDArray[np.int32], at: Int64) -> Int64:
    inside = np.stack((at % BLOCK_SIDE, at // BLOCK_SIDE % BLOCK_SIDE, at // BLOCK_SIDE**2), axis=1)
    return key.astype(np.int64) * BLOCK_SIDE + inside


def _gradients(grid: BlockGrid, keys: NDArray[np.int32], blocks: NDArray[np.int32], row: Int64, at: Int64) -> Float32:
    """Unit normals (N, 3) of voxels, towards free space; zeros where neighbours say nothing."""
    buffers = grid.buffers()
    index = np.full(np.ptp(keys, axis=0) + 3, -1, np.int64)
    inner = keys - keys.min(axis=0) + 1
    index[tuple(inner.T)] = blocks
    own = buffers.tsdf[blocks[row], at]
    local = _voxels(inner[row], at)
    normal = np.empty((len(row), 3), np.float32)
    for axis in range(3):
        sides: list[Float32] = []
        for step in (-1, 1):
            moved = local.copy()
            moved[:, axis] += step
            block = index[tuple((moved >> 3).T)]
            x, y, z = (moved & 7).T
            place = block, z * BLOCK_SIDE**2 + y * BLOCK_SIDE + x
            sides.append(np.where((block >= 0) & (buffers.weight[place] > 0), buffers.tsdf[place], own))
        normal[:, axis] = sides[1] - sides[0]
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-6))


def _effective(votes: Float32, vote_discount: float) -> Float32:
    return np.where(votes > 1, votes / (1 + vote_discount * (votes - 1)), 1).astype(np.float32)


def _log_probabilities(evidence: Float32, votes: Float32, vote_discount: float) -> Float32:
    """(N, L) that stored evidence reads as; zeros without votes."""
    said = evidence * (_effective(votes, vote_discount) / np.maximum(votes, np.float32(1e-6)))[:, None]
    said -= said.max(axis=1, keepdims=True)
    said -= np.log(np.exp(said).sum(axis=1, keepdims=True))
    return np.where(votes[:, None] > 0, said, 0).astype(np.float32)


def group_things(voxels: Int64, channel: Int64, way_m: Float32, voxel_m: float) -> Int64:
    """The thing (N,) that each voxel belongs to, numbered from 0.

    Args:
        voxels: (N, 3) unique coordinates.
        channel: (N,) class of each.
        way_m: (N, 3) from each to the centre of its thing, along the axes of ``voxels``.
        voxel_m: Edge of a voxel.
    """
    if not len(voxels):
        return np.zeros(0, np.int64)
    first, second = _neighbours(voxels)
    same = channel[first] == channel[second]
    first, second = first[same], second[same]
    centre = voxels.astype(np.float64) * voxel_m + way_m.astype(np.float64)
    agree = np.linalg.norm(centre[first] - centre[second], axis=1) < AGREE_M
    piece = _components(len(voxels), first[agree], second[agree])
    return _join_small_pieces(piece, first, second, centre)


def _join_small_pieces(piece: Int64, first: Int64, second: Int64, centre: Float64) -> Int64:
    """Pieces (N,); small ones that touch large ones, by the pairs ``first``, ``second``, are part of them now."""
    size = np.bincount(piece)
    middle = np.stack([np.bincount(piece, centre[:, axis]) for axis in range(3)], axis=1) / size[:, None]
    large = size >= LEAST_VOXELS
    for _ in range(_JOINS):
        a, b = piece[first], piece[second]
        touching = np.concatenate(
            (np.stack((a, b), axis=1)[~large[a] & large[b]], np.stack((b, a), axis=1)[~large[b] & large[a]])
        )
        if not len(touching):
            break
        touching = np.unique(touching, axis=0)
        apart = np.linalg.norm(middle[touching[:, 0]] - middle[touching[:, 1]], axis=1)
        touching = touching[np.lexsort((apart, touching[:, 0]))]
        small, row = np.unique(touching[:, 0], return_index=True)
        becomes = np.arange(len(size))
        becomes[small] = touching[row, 1]
        piece = becomes[piece]
    return np.unique(piece, return_inverse=True)[1].reshape(-1)


def _neighbours(voxels: Int64) -> tuple[Int64, Int64]:
    """Pairs of voxels that touch by face, edge or corner."""
    keys = pack_voxels(voxels)
    order = np.argsort(keys)
    keys = keys[order]
    first: list[Int64] = []
    second: list[Int64] = []
    for step in _HALF_SPHERE:
        wanted = pack_voxels(voxels + step)
        row = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        there = np.flatnonzero(keys[row] == wanted)
        first.append(there)
        second.append(order[row[there]])
    return np.concatenate(first), np.concatenate(second)


def _components(count: int, first: Int64, second: Int64) -> Int64:
    """Number of the connected part that each belongs to. SciPy's libraries need 270 MB, and few sessions refine."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)
