"""NeSF on saved maps: a 3D network that has seen many maps corrects the class probabilities of this one.

It also says how to get from each point to the centre of the object there, by which a map's instances are separated. The
map's surface is pooled to cells of ``CELL_M``; each cell tells the network its shape, colour, and what the votes there
say. The answer is a *residual* on the map's log-probabilities: a vector, how much of the smoothed votes round the cell
is added, and how much a voxel's own still count; an untrained network leaves the map as it is.

Its convolutions are *submanifold* ones over the occupied cells (Graham et al. 2018), in plain torch: they give an
output where there is an input and nowhere else, so that a surface stays a surface. Missing neighbours count as zeros.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from semantic_mapper.config import AtLeastOne, Config, convert_config
from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.checkpoint import load_tensors
from semantic_mapper.fields.weights import (
    MAP_KIND,
    SHIPPED,
    describe,
    open_weights,
    refusing_damage,
    save_tensors,
    unpack_label_set,
)
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32

DEFAULT = SHIPPED / "nesf-rooms.safetensors"  # for maps of the classes of ROOMS
SMOOTHING = Path("smoothed")  # in place of weights: votes are smoothed, nothing is learned
CELL_M = 0.04
SHAPE_CHANNELS = 9  # before those of the classes
UP_CHANNEL, VOTES_CHANNEL = 2, 8
SMOOTHED_ROUNDS = 2  # of a Gaussian over 3^3 cells, sigma one cell: together 1.4 cells, 6 cm
SAME_SLOPE = 0.3  # cells whose normal . up differs by more belong to another surface
LOG_SCALE = 0.25  # log-probabilities reach -12, other channels 1
FARTHEST_M = 0.3  # ways to the centre of an object are learned up to here
MOST_VOTES = 8.0  # further ones tell nothing new
LEVELS = 4
WIDTHS = (1, 2, 4, 4)  # of the levels, times the width
BLOCKS = (1, 2, 2, 2)  # on the way down; one on the way up
CHUNK_ROWS = 1024  # gathered at a time: 27 rows of features each, which stay in the cache
OFFSETS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int64)  # (27, 3)
_BITS, _HALF = 21, 1 << 20  # a packed coordinate


class NesfConfig(Config, frozen=True):
    """Shape of the network."""

    width: AtLeastOne = 16
    centres: bool = True  # whether it has learned where the centres of objects are


class CellLevel(NamedTuple):
    """The occupied cells of one resolution."""

    cells: NDArray[np.int64]  # (N, 3) coordinates, in lexicographic order
    neighbours: torch.Tensor  # (N, 27) rows of the cells round each, in the order of ``OFFSETS``; N = not occupied
    parent: torch.Tensor  # (N,) row in the next coarser level
    corner: torch.Tensor  # (N,) which of the parent's eight
    parents: int  # cells of the next coarser level


def pack_cells(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys (N,) int64 of cells (N, 3), in the same order; coordinates within +-2^20."""
    shifted = cells + _HALF
    return (shifted[..., 0] << (2 * _BITS)) | (shifted[..., 1] << _BITS) | shifted[..., 2]


def find_rows(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each of ``wanted`` stands in sorted ``keys`` (N,); N = nowhere."""
    rows = np.searchsorted(keys, wanted)
    found = keys[np.minimum(rows, len(keys) - 1)] == wanted
    return np.where(found, rows, len(keys))


def cell_levels(cells: NDArray[np.int64], count: int) -> tuple[CellLevel, ...]:
    """Tables of ``count`` resolutions, each half the one before.
    ``cells``: (N, 3) of the finest, unique and in lexicographic order; N > 0."""
    levels: list[CellLevel] = []
    for _ in range(count):
        _, first, parent = np.unique(pack_cells(cells >> 1), return_index=True, return_inverse=True)
        coarse, parent = (cells >> 1)[first], parent.reshape(-1)
        corner = (cells & 1) @ np.array((4, 2, 1))
        neighbours, up, place = (torch.from_numpy(t) for t in (_neighbours(cells), parent, corner))
        levels.append(CellLevel(cells, neighbours, up, place, len(coarse)))
        cells = coarse
    return tuple(levels)


def _neighbours(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows (N, 27) of the cells round each."""
    keys, count = pack_cells(cells), len(cells)
    table = np.full((count, len(OFFSETS)), count, np.int64)
    middle = len(OFFSETS) // 2
    rows = np.arange(count)
    table[:, middle] = rows
    for n in range(middle):  # the rest mirrors these
        found = find_rows(keys, keys + int(pack_cells(OFFSETS[n]) - pack_cells(np.zeros(3, np.int64))))
        table[:, n] = found
        here = found < count
        table[found[here], len(OFFSETS) - 1 - n] = rows[here]
    return table


class _Submanifold(torch.autograd.Function):
    """Gather and multiply in chunks. The gradient of the input is the same convolution with mirrored weights."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(x, weight, table)
        flat, out = weight.reshape(-1, weight.shape[2]), x.new_empty(len(table), weight.shape[2])
        for rows, gathered in _chunks(x, table):
            torch.mm(gathered, flat, out=out[rows])
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, weight, table = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        places, channels_in, channels_out = weight.shape
        if not ctx.needs_input_grad[0]:
            of_weight = x.new_zeros(places * channels_in, channels_out)
            for rows, gathered in _chunks(x, table):
                of_weight.addmm_(gathered.t(), gradient[rows])
            return None, of_weight.view_as(weight), None
        # The table is symmetric: gradients gathered once serve the input and, mirrored, the weights.
        mirrored = weight.flip(0).transpose(1, 2).reshape(-1, channels_in)
        of_x, of_weight = torch.empty_like(x), x.new_zeros(channels_in, places * channels_out)
        for rows, gathered in _chunks(gradient, table):
            torch.mm(gathered, mirrored, out=of_x[rows])
            of_weight.addmm_(x[rows].t(), gathered)
        return of_x, of_weight.view(channels_in, places, channels_out).flip(1).transpose(0, 1), None


def _padded(x: torch.Tensor) -> torch.Tensor:
    return torch.cat((x, x.new_zeros(1, x.shape[1])))


def _chunks(x: torch.Tensor, table: torch.Tensor) -> Iterator[tuple[slice, torch.Tensor]]:
    """Rows, and features of their neighbours (rows, K * C)."""
    padded = _padded(x)
    for start in range(0, len(table), CHUNK_ROWS):
        part = table[start : start + CHUNK_ROWS]
        yield slice(start, start + len(part)), padded.index_select(0, part.reshape(-1)).view(len(part), -1)


class _Convolution(nn.Module):
    """Weight (places, in, out) and bias (out,)."""

    places: ClassVar[int]

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        spread = (2 / (self.places * channels_in)) ** 0.5
        self.weight = nn.Parameter(torch.randn(self.places, channels_in, channels_out) * spread)
        self.bias = nn.Parameter(torch.zeros(channels_out))


class SubmanifoldConv(_Convolution):
    """3^3 convolution over occupied cells; places in the order of ``OFFSETS``."""

    places = 27

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (N, in) of the level's cells -> (N, out)."""
        convolved: torch.Tensor = _Submanifold.apply(x, self.weight, level.neighbours)  # pyright: ignore[reportAssignmentType]
        return convolved + self.bias


class Down(_Convolution):
    """2^3 convolution of stride 2: each coarser cell sees the cells in it."""

    places = 8

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (N, in) of the level's cells -> (P, out) of the next coarser level's."""
        coarse = x.new_zeros(level.parents, self.weight.shape[2])
        # Each cell has one parent: eight products of what stands in the same corner, which needs no padding.
        for corner in range(8):
            here = (level.corner == corner).nonzero()[:, 0]
            coarse = coarse.index_add(0, level.parent[here], x[here] @ self.weight[corner])
        return coarse + self.bias


class Up(_Convolution):
    """Transposed 2^3 convolution back to the cells that are occupied."""

    places = 8

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out)
        self.weight.data *= 8**0.5  # each cell has one parent

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (P, in) of the next coarser level -> (N, out) of the level's cells."""
        count, wide = len(x), self.weight.shape[2]
        spread = x @ self.weight.permute(1, 0, 2).reshape(x.shape[1], 8 * wide)  # (P, 8 * out)
        return spread.view(count * 8, wide).index_select(0, level.parent * 8 + level.corner) + self.bias


class SurfacePoints(NamedTuple):
    """Voxels round a map's surface, with up along z."""

    xyz: Float32  # (N, 3) in cells
    rise: Float32  # (N,) normal . up
    height_m: Float32  # (N,) above the floor
    rgb: Float32  # (N, 3) in 0..1
    log_p: Float32  # (N, L) log-probabilities of the votes; zeros without votes
    votes: Float32  # (N,)

    def rows(self, chosen: NDArray[Any]) -> "SurfacePoints":
        """Some of them, by mask or row."""
        return SurfacePoints(*(values[chosen] for values in self))


class Cells(NamedTuple):
    """Pooled surface."""

    cells: NDArray[np.int64]  # (M, 3) in lexicographic order
    x: torch.Tensor  # (M, C) float32 channels


class Near(NamedTuple):
    """Where N points lie among M cells."""

    rows: torch.Tensor  # (N, 8) of the cells round each, M = none
    weights: torch.Tensor  # (N, 8), whose sum is 1, or 0 where there is no cell


def pool(points: SurfacePoints) -> Cells:
    """Mean of the points in each cell; log-probabilities count by their votes."""
    cell = np.floor(points.xyz).astype(np.int64)
    keys = pack_cells(cell)
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    count = np.diff(starts, append=len(keys)).astype(np.float32)[:, None]
    votes = np.minimum(points.votes, MOST_VOTES)[:, None]
    centred = points.log_p - points.log_p.mean(axis=1, keepdims=True)
    rise = points.rise[:, None]
    seen = points.rgb.any(axis=1, keepdims=True)
    shape = (np.abs(rise), rise, points.height_m[:, None], points.rgb, seen, votes / 4, centred * (LOG_SCALE * votes))
    sums = np.add.reduceat(np.concatenate(shape, axis=1, dtype=np.float32)[order], starts, axis=0)
    said = 4 * sums[:, 7:8]
    pooled = np.concatenate((count / 8, sums[:, :8] / count, sums[:, 8:] / np.maximum(said, 1e-6)), axis=1)
    return Cells(cell[order[starts]], torch.from_numpy(pooled))


def near_cells(xyz: Float32, cells: NDArray[np.int64]) -> Near:
    """Trilinear weights of points (N, 3) in cells, over those of the eight cells round each that there are."""
    keys = pack_cells(cells)
    low = np.floor(xyz - 0.5)
    fraction = (xyz - 0.5 - low).astype(np.float32)
    base = low.astype(np.int64)
    rows = np.empty((len(xyz), 8), np.int64)
    weights = np.empty((len(xyz), 8), np.float32)
    for n, corner in enumerate(np.ndindex(2, 2, 2)):
        rows[:, n] = find_rows(keys, pack_cells(base + corner))
        weights[:, n] = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
    weights[rows == len(keys)] = 0
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-6)
    return Near(torch.from_numpy(rows), torch.from_numpy(weights))


def smoothed(cells: Cells, level: CellLevel) -> torch.Tensor:
    """Log-probabilities (M, L) of cells, centred, averaged over the surface round them. Neighbours count by a Gaussian
    of their distance, by their votes, and only where the surface has the same slope."""
    table, distance = level.neighbours, torch.from_numpy((OFFSETS**2).sum(axis=1)).float()
    rise, votes, said = cells.x[:, UP_CHANNEL], cells.x[:, VOTES_CHANNEL], cells.x[:, SHAPE_CHANNELS:] / LOG_SCALE
    same = (_padded(rise[:, None])[table][..., 0] - rise[:, None]).abs() < SAME_SLOPE
    kernel = torch.exp(-distance / 2) * same
    for _ in range(SMOOTHED_ROUNDS):
        weight = kernel * _padded(votes[:, None])[table][..., 0]
        total = weight.sum(dim=1)
        said = torch.einsum("nk,nkc->nc", weight, _padded(said)[table]) / total.clamp_min(1e-6)[:, None]
        votes = total / kernel.sum(dim=1)
    return said


class Block(nn.Module):
    """``x + linear(relu(conv(norm(x))))``; the linear layer starts at zero."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.conv = SubmanifoldConv(channels, channels)
        self.linear = nn.Linear(channels, channels)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (N, C) of the level's cells -> (N, C)."""
        return x + self.linear(torch.relu(self.conv(self.norm(x), level)))


class MapUNet(nn.Module):
    """A 3D U-Net over the occupied cells of a map, of four levels that all have residual blocks; it sees 1.9 m far.

    Each block normalises the features of a cell on their own, so that what surrounds a tile does not matter. Its last
    layer starts at zero.
    """

    def __init__(self, channels_in: int, channels_out: int, width: int = 16) -> None:
        super().__init__()
        widths = [width * times for times in WIDTHS]
        pairs = list(pairwise(widths))
        self.stem = nn.Linear(channels_in, widths[0])
        self.encoder = nn.ModuleList(
            nn.ModuleList(Block(w) for _ in range(count)) for w, count in zip(widths, BLOCKS, strict=True)
        )
        self.down = nn.ModuleList(Down(fine, coarse) for fine, coarse in pairs)
        self.up = nn.ModuleList(Up(coarse, fine) for fine, coarse in pairs)
        self.decoder = nn.ModuleList(Block(fine) for fine, _ in pairs)
        self.norm = nn.LayerNorm(widths[0])
        self.head = nn.Linear(widths[0], channels_out)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, x: torch.Tensor, levels: Sequence[CellLevel]) -> torch.Tensor:
        """Features (N, C) of the cells of ``cell_levels(cells, LEVELS)`` -> (N, K)."""
        x = self.stem(x)
        kept: list[torch.Tensor] = []
        for n, blocks in enumerate(self.encoder):
            for block in blocks:  # pyright: ignore[reportGeneralTypeIssues]
                x = block(x, levels[n])
            if n + 1 < LEVELS:
                kept.append(x)
                x = self.down[n](x, levels[n])
        for n in reversed(range(LEVELS - 1)):
            x = self.decoder[n](self.up[n](x, levels[n]) + kept[n], levels[n])
        return self.head(torch.relu(self.norm(x)))


class Nesf(nn.Module):
    """The network, the L classes of the maps that it can refine, and the temperature of its answers."""

    def __init__(self, label_set: LabelSet, config: NesfConfig | None = None) -> None:
        super().__init__()
        self.label_set, self.config = label_set, config or NesfConfig()
        self.net = MapUNet(SHAPE_CHANNELS + len(label_set), len(label_set) + 2 + 3, self.config.width)
        self.temperature: torch.Tensor
        self.register_buffer("temperature", torch.ones(()))

    def start_smoothed(self) -> None:
        """Make untrained weights answer with the smoothed votes, which is where training starts."""
        with torch.no_grad():
            self.net.head.bias[-5], self.net.head.bias[-4] = 1.0, -1.0

    def extended(self, label_set: LabelSet) -> "Nesf":
        """The same network for maps of more classes behind its own: votes for those are smoothed."""
        own, more = len(self.label_set), len(label_set) - len(self.label_set)
        found = Nesf(label_set, self.config)
        state = self.state_dict()
        for name, axis, at in (
            ("net.stem.weight", 1, SHAPE_CHANNELS + own),
            ("net.head.weight", 0, own),
            ("net.head.bias", 0, own),
        ):
            before, after = state[name].tensor_split((at,), dim=axis)
            new = before.narrow(axis, 0, 1).expand(*(more if n == axis else -1 for n in range(before.ndim)))
            state[name] = torch.cat((before, torch.zeros_like(new), after), dim=axis)
        found.load_state_dict(state)
        return found.eval()

    def forward(self, cells: Cells) -> torch.Tensor:
        """(M, L + 4) of each cell: residual, how much more the map's log-probabilities count, and the way to its
        object's centre, in units of ``FARTHEST_M``."""
        levels = cell_levels(cells.cells, LEVELS)
        said = self.net(cells.x, levels)
        residual, smoothing, rest = said.split((said.shape[1] - 5, 1, 4), dim=1)
        return torch.cat((residual + smoothing * smoothed(cells, levels[0]), rest), dim=1)

    def read(self, answer: torch.Tensor, near: Near, log_p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits (N, L) at points, before the temperature, and the way (N, 3) to their objects' centres, metres, about
        ``FARTHEST_M`` at most. ``log_p`` (N, L) is what the map says there; zeros without votes."""
        here = torch.einsum("nkc,nk->nc", _padded(answer)[near.rows], near.weights)
        return log_p * (1 + here[:, -4:-3]) + here[:, :-4], here[:, -3:] * FARTHEST_M


SMOOTHED = hashlib.sha256(b"smoothed votes").hexdigest()  # in place of a digest of weights


@dataclass(frozen=True, slots=True, eq=False)
class NesfWeights:
    """A network with its provenance."""

    model: Nesf
    recipe: dict[str, Any] = field(default_factory=dict[str, Any])  # how it was trained, plain data
    digest: str = ""  # SHA-256 of the file, empty before it is written


def smoothed_votes(label_set: LabelSet) -> NesfWeights:
    """Used where no weights fit, and the baseline that weights have to beat: votes smoothed, nothing learned."""
    model = Nesf(label_set, NesfConfig(width=1, centres=False)).eval()
    model.start_smoothed()
    return NesfWeights(model, digest=SMOOTHED)


def find_nesf(weights: Path | None, label_set: LabelSet) -> NesfWeights:
    """What refines maps of some classes.
    ``weights``: file or name; ``SMOOTHING``; None = the weights that ship, or smoothing where the classes are others.
    Weights also refine maps of more classes behind their own, such as ``person`` behind those of rooms. Raises
    WeightsError: no such file, damaged, or weights of another kind."""
    if weights == SMOOTHING:
        return smoothed_votes(label_set)
    found = load_nesf(weights or DEFAULT)
    own = found.model.label_set
    if len(own) < len(label_set) and (own.ids, own.names) == (label_set.ids[: len(own)], label_set.names[: len(own)]):
        return replace(found, model=found.model.extended(label_set))
    return found if weights or own == label_set else smoothed_votes(label_set)


def save_nesf(weights: NesfWeights, path: Path) -> None:
    """Write weights as float16, whole or not at all."""
    model = weights.model
    metadata = describe(MAP_KIND, model.config, model.label_set, weights.recipe)
    tensors = {name: t.detach().half().contiguous().numpy() for name, t in model.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_tensors(tensors, path, metadata)


def load_nesf(path: Path) -> NesfWeights:
    """Read weights that ``save_nesf`` wrote. Raises WeightsError: no such file, damaged, or weights of another kind."""
    tensors, metadata = open_weights(path)
    if metadata.get("field") != MAP_KIND:
        raise WeightsError(
            f"{path}: weights of kind '{metadata.get('field')}', which label frames (`map --weights`); to refine "
            f"maps takes weights of kind '{MAP_KIND}'"
        )
    with refusing_damage(path):
        config = convert_config(json.loads(metadata["model_config"]), NesfConfig, str(path))
        recipe = dict(json.loads(metadata["recipe"]))
        model = Nesf(unpack_label_set(metadata["label_set"]), config)
    load_tensors(model, tensors, path)
    return NesfWeights(model.eval(), recipe, hashlib.sha256(path.read_bytes()).hexdigest())
