"""Panoptic NeRF (Fu et al. 2022): coarse boxes and noisy label images become classes and instances of every view.

Two semantic fields stand on one scene grid. The fixed one says what the boxes at a point say; through it, label images
move the density. The learned one is a head on the grid's features, and decides where boxes overlap or end.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import torch
from torch import nn

from semantic_mapper.config import BoxConfig, PanopticConfig, SamplingConfig
from semantic_mapper.errors import LabelError
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.scene.boxes import Intervals, MovingBoxes, PrimitiveSet, trimmed
from semantic_mapper.fields.scene.grid import GridField, RaySamples, heaviest, ray_fraction, relu_layers
from semantic_mapper.fields.scene.irt import at_measured
from semantic_mapper.fields.scene.march import KEPT
from semantic_mapper.fields.scene.primitives import Primitive, resized
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.types import FieldRender, Int64, RayBatch

# Where boxes need not cover everything (``uncovered`` is stuff), they are coarse: the core of a box holds nothing but
# what it says. Between there and a little beyond its faces may be that, or what needs no box.
CORE = 0.85  # of a box's size
LOOSE_M = 0.04  # beyond its faces
SAMPLES = 8  # samples of a ray that say its class
LEAST = 1e-6  # of a rendered probability
PRESENT = 0.01  # weight from which on something is next to a measured depth
HEAD_WIDTH = 64  # of what says classes
PAIRS = 1 << 19  # of centres and cores that are looked at together
SKY = "sky"  # class of light that leaves the grid and meets no box, where the label set has it


@dataclass(frozen=True, slots=True, eq=False)
class BoxesOnRays:
    """What boxes hold the K samples of R rays."""

    # (R, K, M) bool, whether the sample is in the interval and the box has a say: in a core, those whose centre it
    # holds, such as books in a shelf
    box: torch.Tensor
    index: torch.Tensor  # (R, M) int64 number of the box of each interval, -1 = none
    named: torch.Tensor  # (R, K, L) classes of the boxes there: 0 or 1
    # (R, K, L) what may be there: these, and outside of the cores of boxes what needs no box: 0 or 1
    classes: torch.Tensor
    on_ray: torch.Tensor  # (R, L) bool, classes that are anywhere on the ray
    # (R,) int64 class of light that leaves the grid: of the first box there, else sky; -1 = neither
    behind: torch.Tensor

    @property
    def fixed(self) -> torch.Tensor:
        """The fixed field (R, K, L): equal shares of what boxes say, or of the rest; near their faces half of each."""
        parts = [p / p.sum(-1, keepdim=True).clamp_min(1) for p in (self.named, self.classes - self.named)]
        both = parts[0] + parts[1]
        return both / both.sum(-1, keepdim=True).clamp_min(1)

    def allowed_of(self, points: torch.Tensor) -> torch.Tensor:
        """Probabilities (R, K, L) of what may be there alone; as they are where nothing may be."""
        allowed = points * self.classes
        total = allowed.sum(-1, keepdim=True)
        return torch.where(total > 0, allowed / total.clamp_min(LEAST), points)


class Panoptic(GridField):
    """Classes and instances of one scene from its boxes, its geometry and label images; boxes that move have
    grids of their own. Raises LabelError: a box of a class that the label set lacks."""

    kind = "panoptic"
    knows_classes = True
    class_rows = ("classifier.weight", "classifier.bias")
    channel_of_box: torch.Tensor  # (P,) int64, of boxes that stand still
    thing: torch.Tensor  # (P,) bool
    channel_of_mover: torch.Tensor  # (M,) int64, of boxes that move
    moving_thing: torch.Tensor  # (M,) bool
    held: torch.Tensor  # (H,) int64 ascending, i * P + j where the centre of box i is in the core of box j
    outside: torch.Tensor  # (L,) 1 where a class may be outside of all boxes

    def __init__(self, config: PanopticConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        self.shape = config
        boxes = [primitive_of(b) for b in config.boxes if b.stamps is None]
        movers = [primitive_of(b) for b in config.boxes if b.stamps is not None]
        self.moving = MovingBoxes(movers, config.grid.voxel_m)
        loose = config.uncovered == "stuff"
        self.primitives = PrimitiveSet([resized(b, b.size + 2 * LOOSE_M) for b in boxes] if loose else boxes)
        self.cores = PrimitiveSet([resized(b, CORE * b.size) for b in boxes] if loose else [])
        self.register_buffer("held", torch.from_numpy(self._held()), persistent=False)
        channel = {name: i for i, name in enumerate(label_set.names)}
        for names, those in (("channel_of_box", "thing"), boxes), (("channel_of_mover", "moving_thing"), movers):
            channels = torch.tensor([_channel(channel, b.class_name) for b in those], dtype=torch.long)
            self.register_buffer(names[0], channels, persistent=False)
            things = torch.tensor([b.thing for b in those], dtype=torch.bool)
            self.register_buffer(names[1], things, persistent=False)
        self.register_buffer("outside", torch.tensor(self._allowed_outside(label_set)).float(), persistent=False)
        self.sky = channel.get(SKY)
        self.head = relu_layers(config.trunk_width, HEAD_WIDTH, 1)
        self.classifier = nn.Linear(HEAD_WIDTH, len(label_set))

    def march(self, rays: RayBatch, kept: int = KEPT, jitter: torch.Tensor | None = None) -> RaySamples:
        """The samples of greatest weight of each ray; rays with a time meet the boxes that move, too."""
        samples = super().march(rays, kept, jitter)
        return heaviest(self.moving.composite(samples, kept), kept) if self.fitted else samples

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays; colours and classes are of the same few samples, as in the fit."""
        return self.render_marched(self.march(rays, SAMPLES), sources)

    def classify(self, samples: RaySamples, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
        """Log probabilities (R, L), and where they are known (R,): where a ray meets something, or sees what is behind
        the grid. A ray whose depth was measured ends there."""
        samples = heaviest(self._at_measured(samples), SAMPLES)
        boxes = self.boxes_on(samples)
        points = boxes.fixed if self.shape.classes == "fixed" else boxes.allowed_of(self.learned(samples))
        points = self.of_movers(samples, points)
        rendered = self.composited(samples, points, boxes)
        behind = rendered.argmax(1) == boxes.behind
        return torch.log(rendered.clamp_min(LEAST)), self.known(samples) | (behind & self.fitted)

    def learned(self, samples: RaySamples, r: torch.Tensor | None = None) -> torch.Tensor:
        """The learned field (R, K, L) at samples; ``r`` (R, K, W) is what the trunk says there, if it is known."""
        assert self.trunk is not None
        r = self.trunk(samples.points) if r is None else r
        return torch.softmax(self.classifier(self.head(r)), -1)

    def of_movers(self, samples: RaySamples, points: torch.Tensor) -> torch.Tensor:
        """Probabilities (R, K, L) of points; those of boxes that move have the box's class."""
        if samples.mover is None:
            return points
        own = nn.functional.one_hot(self.channel_of_mover[samples.mover.clamp_min(0)], points.shape[2])
        return torch.where((samples.mover >= 0)[..., None], own.to(points), points)

    def colour(self, samples: RaySamples) -> torch.Tensor:
        """Colours (R, K, 3) in [0, 1] of samples."""
        return self.moving.colour(samples, super().colour(samples))

    def composited(self, samples: RaySamples, points: torch.Tensor, boxes: BoxesOnRays) -> torch.Tensor:
        """Probabilities (R, L) of rays, of those of points (R, K, L) and of what is behind the grid."""
        rendered = (ray_fraction(samples)[..., None] * points).sum(1)
        light = samples.light * (boxes.behind >= 0)
        return rendered.scatter_add(1, boxes.behind.clamp_min(0)[:, None], light[:, None])

    def boxes_on(self, samples: RaySamples) -> BoxesOnRays:
        """What boxes hold samples."""
        z, classes = samples.z.detach(), len(self.label_set)
        found = to_device(trimmed(self.primitives.intervals(samples.rays)), z.device)
        inside = found.inside(z)
        in_core = torch.zeros_like(inside[..., :1])
        if len(self.cores):
            cores = to_device(trimmed(self.cores.intervals(samples.rays)), z.device)
            core = cores.inside(z)
            in_core = core.any(-1, keepdim=True)
            within = self._within(found.index, cores.index)
            inside &= ~in_core | (torch.einsum("rkc,rcm->rkm", core.float(), within.float()) > 0)
        channel = torch.where(found.index < 0, classes, self._channels(found.index))
        named = torch.zeros(*z.shape, classes + 1, device=z.device)
        named.scatter_add_(2, channel[:, None].expand(inside.shape), inside.float())
        named = (named[..., :classes] > 0).float()
        allowed = named
        if self.shape.uncovered == "stuff":
            allowed = torch.where(in_core, named, torch.maximum(named, self.outside))
        return BoxesOnRays(inside, found.index, named, allowed, self.on_ray(found), self._behind(samples.rays, found))

    def on_ray(self, found: Intervals) -> torch.Tensor:
        """Classes (R, L) bool that are anywhere on rays, of the boxes that they meet."""
        classes = len(self.label_set)
        channel = torch.where(found.index < 0, classes, self._channels(found.index))
        there = torch.zeros(len(channel), classes + 1, dtype=torch.bool, device=channel.device)
        there = there.scatter_(1, channel, value=True)[:, :classes]
        if self.shape.uncovered == "stuff":
            there = there | (self.outside > 0)
        if self.sky is not None:
            there[:, self.sky] = True
        return there

    def _held(self) -> Int64:
        """See ``held``; a few centres at a time, so that thousands of boxes need no table of all pairs."""
        centres = np.array([b.T_world_box[:3, 3] for b in self.primitives.primitives]).reshape(-1, 3)
        count, pairs = len(self.cores), [np.zeros(0, np.int64)]
        part = max(PAIRS // max(count, 1), 1)
        for first in range(0, len(centres) if count else 0, part):
            centre, core = self.cores.inside(centres[first : first + part]).nonzero()
            pairs.append((first + centre) * count + core)
        return np.concatenate(pairs)

    def _within(self, box: torch.Tensor, core: torch.Tensor) -> torch.Tensor:
        """Whether the centres of boxes (R, M) are in cores (R, C): (R, C, M) bool."""
        if not len(self.held):
            return torch.zeros(len(box), core.shape[1], box.shape[1], dtype=torch.bool, device=box.device)
        pair = box.clamp_min(0)[:, None] * len(self.cores) + core.clamp_min(0)[:, :, None]
        place = torch.searchsorted(self.held, pair).clamp_max(len(self.held) - 1)
        return self.held[place] == pair

    def _behind(self, rays: RayBatch, found: Intervals) -> torch.Tensor:
        beyond = (found.index >= 0) & (found.leave > self.grid.span(rays)[1][:, None])
        first = found.index.gather(1, beyond.float().argmax(1, keepdim=True))[:, 0]
        return torch.where(beyond.any(1), self._channels(first), -1 if self.sky is None else self.sky)

    def instances(self, rays: RayBatch, label: torch.Tensor) -> torch.Tensor:
        """Which thing rays (R,) see (Eq. 8): ids (R,) of boxes of the class (R,), a channel; 0 outside of all boxes.
        Where boxes of one class overlap, a point is of the one whose centre is nearer."""
        samples = heaviest(self._at_measured(self.march(rays)), SAMPLES)
        fraction = ray_fraction(samples)
        still = fraction if samples.mover is None else fraction * (samples.mover < 0)
        weights = [still.new_zeros(len(label), 1), self._by_box(samples, still, label)]
        if samples.mover is not None:
            mover = samples.mover.clamp_min(0)
            fits = (samples.mover >= 0) & self.moving_thing[mover] & (self.channel_of_mover[mover] == label[:, None])
            by_mover = fraction.new_zeros(len(label), len(self.moving))
            weights.append(by_mover.scatter_add_(1, mover, fraction * fits))
        known = sorted(self.shape.boxes, key=lambda box: box.stamps is not None)  # as the weights are
        ids = torch.tensor([0, *(b.id for b in known)], device=label.device)
        return ids[torch.cat(weights, 1).argmax(1)]

    def _by_box(self, samples: RaySamples, fraction: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        """How much of rays (R,) each box that stands still has (R, P): of the class (R,), and a thing."""
        by_box = fraction.new_zeros(len(label), len(self.primitives))
        if not len(self.primitives):
            return by_box
        rays, boxes = samples.rays, self.boxes_on(samples)
        none = boxes.index < 0
        index = boxes.index.clamp_min(0)
        fits = self.thing[index] & (self._channels(boxes.index) == label[:, None]) & ~none
        inside = boxes.box & fits[:, None]
        centre = rays.origin.new_tensor(np.stack([p.T_world_box[:3, 3] for p in self.primitives.primitives]))
        xyz = rays.origin[:, None] + samples.z[..., None] * rays.direction[:, None]
        away = (xyz[:, :, None] - centre[index][:, None]).norm(dim=-1).masked_fill(~inside, torch.inf)
        nearest = torch.zeros_like(inside).scatter_(2, away.argmin(-1, keepdim=True), value=True) & inside
        return by_box.scatter_add_(1, index, (fraction[..., None] * nearest).sum(1))

    def _at_measured(self, samples: RaySamples) -> RaySamples:
        """Rays whose depth was measured end there: in the box that moves, unless the scene has more next to it."""
        ended, mover = at_measured(samples, self.grid.config), samples.mover
        if mover is None:
            return ended
        weight = ended.weight[:, :-1]
        most, near = weight.amax(1), mover.gather(1, weight.argmax(1, keepdim=True))[:, 0]
        of_scene = (most > PRESENT) & (near < 0)
        last = self.moving.holding(samples.rays, samples.rays.prior_depth_m).masked_fill(of_scene, -1)
        return replace(ended, mover=torch.cat((mover, last[:, None]), 1))

    def solid(self) -> torch.Tensor:
        """Vertices of the grid (X, Y, Z) that are in a box or next to one that is: where density may be."""
        grid = self.grid.config
        x, y = torch.meshgrid(*(torch.arange(float(n)) for n in grid.shape[:2]), indexing="ij")
        start = torch.stack((x, y, torch.full_like(x, -1.0)), -1).view(-1, 3)
        origin = start * grid.voxel_m + torch.tensor(grid.origin_m)
        up = torch.tensor((0.0, 0.0, grid.voxel_m)).expand(len(origin), 3)
        nothing = torch.zeros(len(origin))
        found = trimmed(self.primitives.intervals(RayBatch(origin, up, nothing, nothing + torch.inf, nothing)))
        z = torch.arange(float(grid.shape[2])) + 1
        inside = found.inside(z.expand(len(origin), -1)).any(-1).view(grid.shape)
        grown = nn.functional.max_pool3d(inside[None, None].float(), 3, 1, 1)[0, 0]
        return grown > 0

    def _channels(self, index: torch.Tensor) -> torch.Tensor:
        return self.channel_of_box[index.clamp_min(0)] if len(self.channel_of_box) else torch.zeros_like(index)

    def _allowed_outside(self, label_set: LabelSet) -> list[bool]:
        named = {b.class_name for b in self.shape.boxes if b.stamps is None}
        return [n != SKY and (n in STUFF_NAMES or n not in named) for n in label_set.names]


def merged_classes(label_set: LabelSet, merge: Mapping[str, Sequence[str]]) -> torch.Tensor:
    """(L, L) which classes (columns) a pseudo label (rows) may stand for."""
    group = torch.eye(len(label_set))
    for name, others in merge.items():
        for other in others:
            group[label_set.names.index(name), label_set.names.index(other)] = 1
    return group


def box_config(primitive: Primitive) -> BoxConfig:
    """A primitive as a field keeps it."""
    kept = {name: getattr(primitive, name) for name in BoxConfig.__struct_fields__}
    return msgspec.convert(msgspec.to_builtins(kept, enc_hook=np.ndarray.tolist), BoxConfig)


def primitive_of(box: BoxConfig) -> Primitive:
    """The primitive that a field keeps."""
    kept = {name: getattr(box, name) for name in box.__struct_fields__}
    for name in ("T_world_box", "size", "polygon", "vertices"):
        kept[name] = None if kept[name] is None else np.array(kept[name], np.float64)
    kept["faces"] = None if box.faces is None else np.array(box.faces, np.int64)
    if box.stamps is not None:
        kept["stamps"] = tuple((t, np.array(pose, np.float64)) for t, pose in box.stamps)
    return Primitive(**kept)


def _channel(channels: Mapping[str, int], name: str) -> int:
    if name not in channels:
        raise LabelError(f"a box is of class '{name}', which the label set lacks; it has {', '.join(channels)}")
    return channels[name]
