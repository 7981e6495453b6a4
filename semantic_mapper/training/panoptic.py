"""Fit a Panoptic NeRF to one scene: geometry first, then density, colours and classes together, guided by boxes.

Pixels that show boxes that move are left out of the scene, and fill these boxes' own grids in the end.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.errors import ConfigError, FrameError, WeightsError
from semantic_mapper.fields.scene.boxes import MovingBoxes, RaysInBox
from semantic_mapper.fields.scene.grid import NOTHING, RaySamples, SceneGrid, ray_fraction
from semantic_mapper.fields.scene.panoptic import CORE, LOOSE_M, BoxesOnRays, Panoptic, merged_classes
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training import grid_fit
from semantic_mapper.training.config import FinetuneConfig, PanopticFitConfig
from semantic_mapper.training.fit import Budget, FitTask, Fitted, descend, fit
from semantic_mapper.training.views import FrameRays, frame_rays, pixel_channels
from semantic_mapper.types import Bool, Float32, Float64, Int64, PosedFrame

GRID_UNTIL = 0.35  # fraction of the time for geometry and colours alone
SAMPLES = 8  # of a ray, those of greatest weight
DENSITY_RATE = 0.05
SEMANTICS, DEPTH = 0.05, 0.1  # weights of all that classes are learned from, and of rendered depth, against colours
FINAL_RATE = 0.1  # what is left of all rates in the end
LEAST = 1e-4  # of the probability that a pseudo label has: below, it has no gradient
POINT_WEIGHT = 0.05  # from which on a sample says what is there
DEPTH_REACH = 0.05  # 1 / m, of inverse depth: a larger error counts linearly
SURVEYED = 20000  # rays that say how much of the images boxes cover
FEW_COVERED = 0.01  # fraction of pixels that meet a box, below which the log is warned about
FEW_MATCHED = 0.5  # fraction of the pseudo labels that are possible on their ray, below which the log is warned about
LEARNED = 10  # steps of the second part, below which the learned classes of a stopped fit are hardly more than noise
EMPTY_EVERY = 50  # steps between two looks at which cells are empty
ELSEWHERE = 0.05  # of z, by which measured depth lies before a box or behind it where a pixel shows something else
LEAST_PIXELS = 50  # measured inside of a box in all frames, below which nothing is known of its inside
OPAQUE_RAW = 9.0  # raw density of a box of whose inside nothing is known
FAR_M = 1e4  # z of what does not hide anything of a box
SPREAD = 5  # voxels over which colours are averaged
_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class PseudoRays:
    """All pixels of F frames with their pseudo labels."""

    rays: FrameRays  # of the frames
    channel: torch.Tensor  # (P,) int64, -1 = none
    gain: torch.Tensor  # (F, 3) exposure of the frames
    still: Int64  # numbers of the pixels that show what stands still


def fit_panoptic(task: FitTask) -> Fitted:
    """Fit a ``Panoptic``; stopped before its classes are learned, these are those of the boxes alone.

    The label images of the frames are the pseudo labels. ``start`` is a ``Panoptic`` with the boxes, whose weights are
    not looked at; there may be none where ``config`` leaves out the losses that need some. ``budget.steps``, if not 0,
    is the number of steps of each of its two parts. Raises ConfigError: no boxes, none of them in view, or no class in
    common with the pseudo labels. FrameError: no pseudo label, or what ``fit_grid`` refuses. WeightsError: ``start``
    has other classes.
    """
    _, label_set, start, config, budget = task
    by_boxes = config.panoptic.fixed > 0 or config.panoptic.points > 0
    if not isinstance(start, Panoptic) or (by_boxes and not start.shape.boxes):
        raise ConfigError("a field of kind 'panoptic' needs boxes; give a file of them (--boxes)")
    if start.label_set != label_set:
        raise WeightsError(f"the boxes are of label set '{start.label_set.name}', the labels of '{label_set.name}'")
    frames = held_out_unlabelled(task.frames, config.grid.held_out)
    everything = pseudo_rays(frames, label_set, config.width)
    _, shown = shown_boxes(start.moving, frames, everything.rays)
    gone = {box.id for box, count in zip(start.moving.primitives, shown, strict=True) if not count}
    lost, boxes = len(gone), tuple(box for box in start.shape.boxes if box.id not in gone)
    if lost:
        _log.warning("moving_boxes_left_out", count=lost, reason="no frame shows them at their times")
    if by_boxes and not boxes:
        places = np.array([box.T_world_box[:3, 3] for box in start.moving.primitives])
        raise nothing_in_view(places, places, everything.rays.T_world_camera[:, :3, 3])
    survey = survey_boxes(start, everything, config)

    def shows_movers(seen: Sequence[PosedFrame], rays: FrameRays) -> Bool:
        return shown_boxes(start.moving, seen, rays)[0]

    shape = msgspec.structs.replace(start.shape, boxes=boxes)
    field, grid = grid_fit.fit_geometry(task._replace(frames=frames), shape, Panoptic.kind, GRID_UNTIL, shows_movers)
    assert isinstance(field, Panoptic)
    data = pseudo_rays(grid.frames, label_set, config.width)
    still = np.flatnonzero(~shows_movers(grid.frames, data.rays))
    data = replace(data, gain=torch.from_numpy(grid.gains), still=still)
    steps = JointFit(field, data, config).run(budget.part(1.0))
    if steps < LEARNED and budget.stopped():
        field.shape = field.config = msgspec.structs.replace(field.shape, classes="fixed")
    fill_boxes(field, grid.frames, data.rays, grid.gains, config.grid.near_m)
    found = survey | {
        "moving": len(start.moving) - lost,
        "lost": lost,
        "labelled_frames": sum(f.label is not None for f in frames),
        "frames": len(frames),
    }
    figures = grid_fit.grid_figures(grid) | {"grid_steps": grid.steps, "steps": steps, "panoptic": found}
    return Fitted(field, figures, [f for f in frames if f.label is not None and not f.label_is_pseudo])


def held_out_unlabelled(frames: Sequence[PosedFrame], every: int) -> list[PosedFrame]:
    """Frames so that each ``every``-th, which ``fit_grid`` holds out, is without labels where there are such frames."""
    plain, labelled = ([f for f in frames if (f.label is None) == none] for none in (True, False))
    if not every or not plain:
        return list(frames)
    ordered: list[PosedFrame] = []
    while plain or labelled:
        held_out = (len(ordered) + 1) % every == 0
        ordered.append((plain if plain and (held_out or not labelled) else labelled).pop(0))
    return ordered


def pseudo_rays(frames: Sequence[PosedFrame], label_set: LabelSet, width: int) -> PseudoRays:
    """The pixels of frames with their label images.
    Raises FrameError: no frame has one, or nothing is known in any of them."""
    rays = frame_rays(frames, width)
    if all(f.label is None for f in frames):
        raise FrameError("no frame has a pseudo label; give a folder of them or weights that make some (--pseudo)")
    channels = pixel_channels(frames, rays, label_set)
    if not (channels >= 0).any():
        raise FrameError(
            f"all pixels of all {sum(f.label is not None for f in frames)} pseudo labels are unknown (id "
            f"{label_set.ignore_id}), so that they teach nothing; give others (--pseudo)"
        )
    return PseudoRays(rays, channels, torch.ones(len(frames), 3), np.arange(len(rays)))


def survey_boxes(field: Panoptic, data: PseudoRays, config: FinetuneConfig) -> dict[str, float]:
    """How many ``boxes`` stand still and are ``seen``; fractions of some of the pixels whose ray meets one
    (``covered``), and of those with a pseudo label whose class is possible on their ray (``matched``).
    Raises ConfigError: no pixel meets a box, or boxes and pseudo labels have no class in common."""
    if not len(field.primitives):
        return {"boxes": 0, "seen": 0, "covered": 0.0, "matched": 1.0}
    pixels = np.random.default_rng(config.seed).integers(0, len(data.rays), SURVEYED)
    rays = data.rays.rays(pixels, config.grid.near_m)
    found = field.primitives.intervals(rays)
    covered = (found.count > 0).float().mean().item()
    names = field.label_set.names
    if covered == 0:
        meshes = field.primitives.meshes
        raise nothing_in_view(meshes.low, meshes.high, data.rays.T_world_camera[:, :3, 3])
    if covered < FEW_COVERED:
        _log.warning("few_boxes_in_view", covered=round(covered, 4), reason="are they in the log's world frame?")
    group = merged_classes(field.label_set, field.shape.merge)
    said = data.channel[data.channel >= 0].unique()
    boxed = field.channel_of_box.unique()
    if not (group[said][:, boxed] > 0).any():
        raise ConfigError(
            f"pseudo labels and boxes have no class in common: labels say {', '.join(names[i] for i in said)}, boxes "
            f"{', '.join(names[i] for i in boxed)}. `merge` of boxes.json says which stand for others"
        )
    channel = data.channel[torch.from_numpy(pixels)]
    matched = possible(field.on_ray(found), group, channel)[channel >= 0].float().mean().item()
    if matched < FEW_MATCHED:
        _log.warning(
            "few_labels_match", matched=round(matched, 4), reason="most name a class that no box on their ray has"
        )
    seen = len(found.index[found.index >= 0].unique())
    return {"boxes": len(field.primitives), "seen": seen, "covered": round(covered, 4), "matched": round(matched, 4)}


def possible(on_ray: torch.Tensor, group: torch.Tensor, channel: torch.Tensor) -> torch.Tensor:
    """u(r) (R,): whether what a pseudo label (R,) may stand for is on the ray (R, L); False without a label."""
    return ((group[channel.clamp_min(0)] > 0) & on_ray).any(1) & (channel >= 0)


def semantic_losses(
    field: Panoptic,
    samples: RaySamples,
    boxes: BoxesOnRays,
    learned: torch.Tensor,
    channel: torch.Tensor,
    group: torch.Tensor,
    weights: PanopticFitConfig,
) -> torch.Tensor:
    """Eq. 5 and 6: the pseudo labels (R,) ``channel`` against the fixed field and the learned one (R, K, L), and this
    one against the boxes. ``group`` (L, L): what the pseudo labels, -1 = none, may stand for."""
    there = channel >= 0
    stands_for = group[channel.clamp_min(0)]
    count = there.sum().clamp_min(1)
    fixed = (field.composited(samples, boxes.fixed, boxes) * stands_for).sum(1)
    seen = (field.composited(samples, learned, boxes) * stands_for).sum(1)
    by_fixed = -(torch.log(fixed.clamp_min(LEAST)) * there).sum() / count
    by_learned = -(torch.log(seen.clamp_min(LEAST)) * possible(boxes.on_ray, group, channel)).sum() / count
    # Where one class is allowed this is the paper's cross-entropy; where there are several, one of them has to be it.
    allowed = (learned * boxes.classes).sum(-1)
    surface = (samples.weight.detach() > POINT_WEIGHT) & (boxes.classes.sum(-1) > 0)
    by_points = -(torch.log(allowed.clamp_min(LEAST)) * surface).sum() / surface.sum().clamp_min(1)
    return weights.fixed * by_fixed + weights.learned * by_learned + weights.points * by_points


class JointFit:
    """The second part of a fit: density, features, colours and classes from one batch of rays a step."""

    def __init__(self, field: Panoptic, data: PseudoRays, config: FinetuneConfig) -> None:
        self.field, self.data, self.config = field, data, config
        self.rng = np.random.default_rng(config.seed)
        self.group = merged_classes(field.label_set, field.shape.merge)
        assert field.trunk is not None
        self.optimiser = grid_fit.trunk_optimiser(field.trunk, field.head, field.classifier)
        self.rates = [group["lr"] for group in self.optimiser.param_groups]
        field.grid.values.requires_grad_(True)
        self.adam = grid_fit.GridAdam(field.grid, data.rays, config.grid.near_m)
        self.solid = field.solid() if field.shape.uncovered == "empty" else None
        self.step = 0
        self._empty_cells()

    def run(self, budget: Budget) -> int:
        """Learn until the budget is used; returns the number of steps."""
        steps = fit(self._learn, budget)
        self._empty_cells()
        self.field.grid.values.requires_grad_(False)
        self.field.eval()
        return steps

    def _learn(self, fraction: float) -> float:
        field, config = self.field, self.config
        left = FINAL_RATE**fraction
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * left
        pixels = self.data.still[self.rng.integers(0, len(self.data.still), config.step.rays)]
        batch = self.data.rays.rays(pixels, config.grid.near_m)
        samples = field.march(batch, SAMPLES, torch.from_numpy(self.rng.random(len(pixels), np.float32)))
        assert field.trunk is not None
        r = field.trunk(samples.points)
        share = ray_fraction(samples)
        behind = field.grid.sky_colour(batch.direction) * samples.light[:, None]
        colour = (share[..., None] * field.trunk.colour(r, batch.direction)).sum(1) + behind
        gain = self.data.gain[torch.from_numpy(self.data.rays.frame_of(pixels))]
        loss = functional.mse_loss(gain * colour, self.data.rays.colours(pixels))
        loss = loss + DEPTH * self._depth_loss(samples, share, pixels)
        channel = self.data.channel[torch.from_numpy(pixels)]
        boxes = field.boxes_on(samples)
        learned = field.learned(samples, r)
        losses = semantic_losses(field, samples, boxes, learned, channel, self.group, config.panoptic)
        loss = loss + SEMANTICS * losses
        field.grid.values.grad = None
        total = descend(self.optimiser, loss)
        gradient = field.grid.values.grad
        assert gradient is not None
        self.adam.step(gradient.contiguous().numpy(), DENSITY_RATE * left, 0.0)
        self.step += 1
        if self.step % EMPTY_EVERY == 0:
            self._empty_cells()
        return total

    def _depth_loss(self, samples: RaySamples, share: torch.Tensor, pixels: np.ndarray) -> torch.Tensor:
        """Huber of inverse depth, where depth is known, in units of its reach."""
        measured = torch.from_numpy(self.data.rays.depth_m[pixels])
        known = (measured > 0) & (samples.opacity.detach() > 0.5)
        z = (share * samples.z).sum(1) / samples.opacity.clamp_min(1e-6)
        error = (1 / z.clamp_min(1e-3) - 1 / measured.clamp_min(1e-3)) / DEPTH_REACH
        return (functional.huber_loss(error, torch.zeros_like(error), reduction="none") * known).mean()

    def _empty_cells(self) -> None:
        """Empty what lies outside of all boxes, where nothing may be there, and find the cells that rays may skip."""
        with torch.no_grad():
            if self.solid is not None:
                self.field.grid.values[..., 0].masked_fill_(~self.solid, NOTHING)
            self.field.grid.update_occupied()


def boxes_in_view(boxes: Sequence[Primitive], frames: Sequence[PosedFrame]) -> Bool:
    """Which boxes (P,) may be in the image of a frame: their balls at its time meet the cone through its corners; what
    hides them is ignored. Raises ConfigError: no box may be in any image."""
    pose = np.array([frame.T_world_camera for frame in frames]).reshape(-1, 4, 4)
    cone = np.array([_half_angle(frame) for frame in frames])
    seen = np.zeros(len(boxes), np.bool_)
    for number, box in enumerate(boxes):
        radius = float(np.linalg.norm(box.size / 2 + LOOSE_M))
        there = [box.T_world_box if box.stamps is None else box.pose_at(frame.stamp_ns) for frame in frames]
        shown = np.array([place is not None for place in there], np.bool_)
        if not shown.any():
            continue
        away = np.array([p[:3, 3] for p in there if p is not None]) - pose[shown, :3, 3]
        z, distance = (away * pose[shown, :3, 2]).sum(1), np.linalg.norm(away, axis=1)
        angle = np.arccos(np.clip(z / np.maximum(distance, 1e-9), -1, 1))
        wide = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0, 1))
        seen[number] = ((distance <= radius) | (angle <= cone[shown] + wide)).any()
    if len(boxes) and not seen.any():
        places = np.array([box.T_world_box[:3, 3] for box in boxes])
        raise nothing_in_view(places, places, pose[:, :3, 3])
    return seen


def nothing_in_view(low: Float64, high: Float64, cameras: Float64 | Float32) -> ConfigError:
    """That no box is in view of any frame, with where boxes (P, 3) and cameras (F, 3) are."""
    lowest, highest, first, last = (
        "(" + ", ".join(f"{x:.2f}" for x in xyz) + ") m"
        for xyz in (low.min(0), high.max(0), cameras.min(0), cameras.max(0))
    )
    return ConfigError(
        f"no box is in view of any frame: boxes lie from {lowest} to {highest}, cameras from {first} to {last}. Are "
        "the boxes in the log's world frame, and the stamps of those that move the log's, in nanoseconds?"
    )


def _half_angle(frame: PosedFrame) -> float:
    """Of the cone round the optical axis that holds the image, radians."""
    k = frame.intrinsics
    x = max(k.cx + 0.5, k.width - 0.5 - k.cx) / k.fx
    y = max(k.cy + 0.5, k.height - 0.5 - k.cy) / k.fy
    return float(np.arctan(np.hypot(x, y)))


def shown_boxes(boxes: MovingBoxes, frames: Sequence[PosedFrame], rays: FrameRays) -> tuple[Bool, Int64]:
    """Which pixels (P,) of frames may show a box that moves, and how many may show each box (M,)."""
    shown, count = np.zeros(len(rays), np.bool_), np.zeros(len(boxes), np.int64)
    for number, frame in enumerate(frames):
        for met, pixels in _met(boxes, frame, rays, number):
            depth = torch.from_numpy(rays.depth_m[pixels])
            enter = met.found.enter.amin(1)
            leave = met.found.leave.masked_fill(met.found.index < 0, -torch.inf).amax(1)
            known = depth > 0
            elsewhere = known & ((depth < (1 - ELSEWHERE) * enter) | (depth > (1 + ELSEWHERE) * leave))
            shown[pixels[~elsewhere.numpy()]] = True
            count[met.number] += int((~elsewhere).sum())
    return shown, count


def fill_boxes(field: Panoptic, frames: Sequence[PosedFrame], rays: FrameRays, gains: Float32, near_m: float) -> None:
    """Fill the grids of the boxes that move from depth images and colours with ``gains`` (F, 3). What the scene itself
    has at a measured depth, such as the road under a car, is not of the box. Where no frame measures the inside of a
    box, its core is full."""
    boxes = field.moving
    depths = [np.zeros_like(rays.depth_m) for _ in boxes.primitives]
    measured = np.zeros(len(boxes), np.int64)
    for number, frame in enumerate(frames):
        for met, pixels in _met(boxes, frame, rays, number):
            depth = rays.depth_m[pixels].copy()
            surface = grid_fit.surface_depth(field, rays, pixels, near_m).numpy()
            depth[(depth > 0) & (surface > 0) & (depth > (1 - ELSEWHERE) * surface)] = FAR_M
            depths[met.number][pixels] = depth
            measured[met.number] += int(met.found.inside(torch.from_numpy(depth)[:, None]).any(-1).sum())
    poses = rays.T_world_camera.astype(np.float64)
    for box, depth in enumerate(depths):
        T_box_camera = poses.copy()
        for number, frame in enumerate(frames):
            T_world_box = boxes.primitives[box].pose_at(frame.stamp_ns)
            if T_world_box is not None:
                T_box_camera[number] = invert_pose(T_world_box) @ poses[number]
        own = replace(rays, T_world_camera=T_box_camera.astype(np.float32), depth_m=depth)
        grid = boxes.grid(box)
        if measured[box] < LEAST_PIXELS:
            _fill_core(grid)
            continue
        filled = grid_fit.grid_of_depth(own, grid.config, NOTHING)
        grid.load_state_dict(filled.state_dict())
        _paint(grid, own, gains)


def _fill_core(grid: SceneGrid) -> None:
    """Make the core of a box opaque, with round edges, as things have; grey."""
    axes = torch.meshgrid(*(torch.linspace(-1, 1, n) for n in grid.config.shape), indexing="ij")
    inside = torch.stack(axes).pow(4).sum(0) <= CORE**4
    with torch.no_grad():
        grid.values[..., 0] = torch.where(inside, OPAQUE_RAW, NOTHING)
    grid.update_occupied()


def _paint(grid: SceneGrid, rays: FrameRays, gains: Float32) -> None:
    """Colours of the measured points in the grid, averaged over some voxels; grey away from them."""
    pixels = np.flatnonzero((rays.depth_m > 0) & (rays.depth_m < FAR_M))
    depth = torch.from_numpy(rays.depth_m[pixels])[:, None]
    vertex = grid.points(rays.rays(pixels, 0.0), depth)[:, 0].round().long()
    inside = ((vertex >= 0) & (vertex < torch.tensor(grid.config.shape))).all(1)
    colour = torch.from_numpy(rays.rgb[pixels] / np.float32(255) / gains[rays.frame_of(pixels)])
    found = torch.zeros(*grid.config.shape, 4)
    found.index_put_(tuple(vertex[inside].T), functional.pad(colour[inside], (0, 1), value=1.0), accumulate=True)
    mean = functional.avg_pool3d(found.permute(3, 0, 1, 2), SPREAD, 1, SPREAD // 2)
    known = mean[3] > 0
    painted = torch.logit((mean[:3] / mean[3].clamp_min(1e-9)).clamp(0.01, 0.99)).permute(1, 2, 3, 0)
    with torch.no_grad():
        grid.values[..., 1:] = torch.where(known[..., None], painted, torch.zeros(()))


def _met(boxes: MovingBoxes, frame: PosedFrame, rays: FrameRays, number: int) -> list[tuple[RaysInBox, Int64]]:
    """The boxes that pixels of a frame meet, and which pixels."""
    pixels = rays.pixels_of(number)
    batch = replace(rays.rays(pixels, 0.0), stamp_ns=frame.stamp_ns)
    return [(met, pixels[met.ray.numpy()]) for met in boxes.met(batch)]
