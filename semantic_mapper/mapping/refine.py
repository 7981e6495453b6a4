"""Refining a map: a network that has seen many maps corrects what the votes say, and labels surface without votes.

The map is read in tiles, so that memory does not grow with it; they overlap by the 1.9 m that the network sees. What it
answers is written back as evidence that reads as exactly that. TSDF, colour and weights stay as they are, bit for bit.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from semantic_mapper.errors import MapError, WeightsError
from semantic_mapper.fields.nesf import CELL_M, SMOOTHED, Near, Nesf, NesfWeights, SurfacePoints, near_cells, pool
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_grid import BLOCK_SIDE, BlockGrid
from semantic_mapper.mapping.blocks import find_blocks, pack_keys
from semantic_mapper.mapping.floor_plan import find_up
from semantic_mapper.mapping.fusion import EVIDENCE_STEPS, PROBABILITY_FLOOR, SURFACE_WEIGHT, evidence_of
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Bool, Float32, Float64, Int32, Int64, UInt16

TILE_M = 8.0
OVERLAP_M = 1.9
LARGEST_VOXEL_M = 0.06  # the network knows cells of 4 cm
BAND_VOXELS = 2.0  # voxels this near the surface are filled, as near as votes reach
FILL_VOTES = 0.3  # of what is filled: later votes of frames outweigh it
FILL = 0.5
ANSWERED_AT_ONCE = 65_536
LOW_PERCENT = 1.0  # of the surface's points that lie below the floor, by noise


class UpFrame(NamedTuple):
    """Where up is: R (3, 3) turns the world so that up is z; floor_m is the floor's height there."""

    R: Float64
    floor_m: float


class SurfaceVoxels(NamedTuple):
    """Voxels near the surface in some blocks: block (N, 3) and voxel (N,) of each, and what the network takes of them.

    ``core`` (N,) are so near the surface that they make up the cells."""

    key: Int32
    at: Int64
    points: SurfacePoints
    core: Bool

    @property
    def voxel(self) -> Int64:
        """(N, 3) coordinates in voxels."""
        return _voxels(self.key, self.at)


@dataclass(frozen=True, slots=True)
class RefineReport:
    """What became of the surface: its voxels by class name before and after ("unknown" last), and of them all, those
    with another class than before, and those that had no votes and have a class now; whether anything had votes."""

    before: dict[str, int]
    after: dict[str, int]
    surface: int
    relabelled: int
    filled: int
    voted: bool


class _Written(NamedTuple):
    """New evidence of voxels (N,), not yet in the map, and the place of their tile along x."""

    column: int
    key: Int32
    at: Int64
    evidence: UInt16
    votes: Float32


def refine(
    voxel_map: VoxelMap,
    weights: NesfWeights,
    *,
    fill: float = FILL,
    up: Float64 | None = None,
    by_name: bool = False,
    on_tile: Callable[[int, int], object] = lambda done, total: None,
) -> RefineReport:
    """Refine a map in place; others may read it meanwhile, but not integrate. ``MapError``: an empty map, one already
    refined, voxels over 6 cm, lengths that are not metres, or no up is found; ``WeightsError``: weights of other
    classes.

    Args:
        fill: Surface without votes gets a class where it is at least so likely; 1 = never.
        up: (3,) in the world; None = away from the floor.
        by_name: Take classes that have the same name in both; the probability of the others stays as it is.
        on_tile: Called after each with tiles done and all tiles."""
    check_refinable(voxel_map)
    shared = _shared_classes(voxel_map.label_set, weights.model.label_set, by_name=by_name)
    frame = up_frame(voxel_map, up)
    overlap = int(np.ceil(OVERLAP_M / (BLOCK_SIDE * voxel_map.config.voxel_size_m)))
    counts = np.zeros((len(voxel_map.label_set) + 1,) * 2, np.int64)  # [before, after] by channel, unknown last
    waiting: deque[_Written] = deque()
    tiles = list(_tiles(voxel_map))
    for n, (column, low, high) in enumerate(tiles):
        while waiting and waiting[0].column < column - 1:  # no later tile reads them
            _write(voxel_map, waiting.popleft())
        voxels = surface_voxels(voxel_map, frame, low - overlap, high + overlap)
        own = np.asarray(((voxels.key >= low) & (voxels.key < high)).all(axis=1), np.bool_)
        if voxels.core.any() and own.any():
            written = _refine_tile(voxel_map, weights.model, voxels, own, shared, fill, counts)
            waiting.append(written._replace(column=column))
        on_tile(n + 1, len(tiles))
    for written in waiting:
        _write(voxel_map, written)
    voxel_map.refined = weights.digest
    return _report(counts, voxel_map.label_set)


def check_refinable(voxel_map: VoxelMap) -> None:
    """Refuse maps that the network cannot refine: ``MapError`` says why."""
    size = voxel_map.config.voxel_size_m
    if not voxel_map.block_count:
        raise MapError("an empty map has nothing to refine; map a frame first")
    if voxel_map.refined:
        smoothed = voxel_map.refined == SMOOTHED
        how = "its votes were smoothed" if smoothed else f"weights of digest {voxel_map.refined[:12]}"
        raise MapError(f"the map is refined already ({how}); refine the map that it was made from")
    if size > LARGEST_VOXEL_M:
        raise MapError(
            f"voxels of {size * 100:g} cm are too coarse to refine (at most {LARGEST_VOXEL_M * 100:g} cm); replay the "
            "log with a smaller --voxel-size"
        )
    if not voxel_map.scale_known:
        raise MapError("the map's lengths are not metres, which the network learned in; import the film with --scale")


def _shared_classes(mine: LabelSet, theirs: LabelSet, *, by_name: bool) -> tuple[Int64, Int64]:
    """Channels (S,) of the map and of the network that mean the same class."""
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
    """Which way is up, and where the floor is: nearly the lowest surface. ``MapError`` where neither is to be found."""
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
        said = buffers.evidence[blocks[row], at] * (_effective(votes, config.vote_discount) / -EVIDENCE_STEPS)[:, None]
        said -= said.max(axis=1, keepdims=True)
        said -= np.log(np.exp(said).sum(axis=1, keepdims=True))
        log_p = np.where(votes[:, None] > 0, said, 0).astype(np.float32)
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


def _refine_tile(
    voxel_map: VoxelMap,
    model: Nesf,
    voxels: SurfaceVoxels,
    own: Bool,
    shared: tuple[Int64, Int64],
    fill: float,
    counts: Int64,
) -> _Written:
    """New evidence of the ``own`` voxels of a tile; ``counts`` take what became of them."""
    mine, theirs = shared
    points = voxels.points
    known = np.zeros((len(own), len(model.label_set)), np.float32)
    voted = points.votes > 0
    if len(theirs) < len(model.label_set):
        known[voted] = np.log(PROBABILITY_FLOOR)
    known[:, theirs] = np.where(voted[:, None], points.log_p[:, mine], 0)
    cells = pool(points._replace(log_p=known).rows(voxels.core))
    near = near_cells(points.xyz[own], cells.cells)
    before = points.log_p[own]
    with torch.inference_mode():
        answer = model(cells)
        said = _read_answer(model, answer, near, torch.from_numpy(known[own]), torch.from_numpy(theirs)).numpy()
    voted, reached = voted[own], (near.weights.sum(1) > 0.5).numpy()
    # What the classes have together that the network does not know stays; the rest it shares out.
    together = np.zeros((len(said), 1), np.float32)
    if len(mine) < before.shape[1]:
        together[voted, 0] = np.log(np.exp(before[np.ix_(voted, mine)]).sum(axis=1) + np.float32(1e-9))
    after = before.copy()
    after[:, mine] = together + said
    after[np.ix_(~voted, np.setdiff1d(np.arange(before.shape[1]), mine))] = np.log(PROBABILITY_FLOOR)
    filled = ~voted & reached & (np.exp(said.max(axis=1)) >= fill) & (fill < 1)
    changed = (voted & reached) | filled
    core = voxels.core[own]
    old = np.where(voted, before.argmax(axis=1), -1)
    new = np.where(changed, after.argmax(axis=1), old)
    np.add.at(counts, (old[core], new[core]), 1)
    votes = np.where(voted, points.votes[own], np.float32(FILL_VOTES))[changed]
    evidence = evidence_of(after[changed] / _effective(votes, voxel_map.config.vote_discount)[:, None])
    return _Written(0, voxels.key[own][changed], voxels.at[own][changed], evidence, votes)


def _read_answer(
    model: Nesf, answer: torch.Tensor, near: Near, log_p: torch.Tensor, channels: torch.Tensor
) -> torch.Tensor:
    """Log-probabilities (N, S) of some channels at points."""
    parts: list[torch.Tensor] = []
    for start in range(0, len(log_p), ANSWERED_AT_ONCE):
        rows = slice(start, start + ANSWERED_AT_ONCE)
        logits, _ = model.read(answer, Near(near.rows[rows], near.weights[rows]), log_p[rows])
        parts.append(torch.log_softmax(logits[:, channels] / model.temperature, dim=1))
    return torch.cat(parts)


def _report(counts: Int64, label_set: LabelSet) -> RefineReport:
    names = (*label_set.names, "unknown")
    before, after = (dict(zip(names, counts.sum(axis=axis).tolist(), strict=True)) for axis in (1, 0))
    voted = counts[:-1]
    return RefineReport(
        before,
        after,
        surface=int(counts.sum()),
        relabelled=int(voted.sum() - voted.trace()),
        filled=int(counts[-1, :-1].sum()),
        voted=bool(voted.any()),
    )


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


def _tiles(voxel_map: VoxelMap) -> Iterator[tuple[int, Int64, Int64]]:
    """Number along x, first block and end of boxes that together hold all blocks, in the order of x."""
    with voxel_map.locked() as grid:
        keys = grid.all_keys().astype(np.int64)
    low, high = keys.min(axis=0), keys.max(axis=0) + 1
    most = max(1, round(TILE_M / (BLOCK_SIDE * voxel_map.config.voxel_size_m)))
    count = -(-(high - low) // most)
    side = -(-(high - low) // count)
    for place in np.ndindex(*count):
        start = low + side * place
        end = np.minimum(start + side, high)
        if ((keys >= start) & (keys < end)).all(axis=1).any():
            yield place[0], start, end


def _voxels(key: Int32, at: Int64) -> Int64:
    inside = np.stack((at % BLOCK_SIDE, at // BLOCK_SIDE % BLOCK_SIDE, at // BLOCK_SIDE**2), axis=1)
    return key.astype(np.int64) * BLOCK_SIDE + inside


def _gradients(grid: BlockGrid, keys: Int32, blocks: Int32, row: Int64, at: Int64) -> Float32:
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
