"""Frames as fits take them: labelled views and who sees whom of them, or the rays of all pixels of many frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import FrameError, PoseError
from semantic_mapper.fields.numbers import UNSURE_SPREAD
from semantic_mapper.fields.sampling import around_computed
from semantic_mapper.fields.volume import sample_guided, sample_inverse_depth
from semantic_mapper.geometry import GUESSED_DEPTHS_M, camera_matrix, check_pose, transform, unproject, visible_points
from semantic_mapper.imaging import resize_depth, resize_label, resize_rgb, resize_spread, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.rays import pixel_rays
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int64, PosedFrame, RayBatch, SourceViews, UInt8

_log = get_logger(__name__)

PROBE = 24  # pixels a row of a view that overlap is found with


@dataclass(frozen=True, slots=True, eq=False)
class LabelledView:
    """One posed image at training resolution."""

    rgb: torch.Tensor  # (3, H, W) float32 in [0, 1]
    depth_m: torch.Tensor  # (H, W) float32, 0 = none
    channel: torch.Tensor  # (H, W) int64 class channels, -1 = ignore
    intrinsics: CameraIntrinsics  # of (H, W)
    T_world_camera: torch.Tensor  # (4, 4) float32
    # (H, W) float32 depth that was computed from pictures, 0 = none: what a field is given in the place of ``depth_m``,
    # which remains what it is to render. None = a field is given ``depth_m``.
    computed_m: torch.Tensor | None = None
    computed_sigma_m: torch.Tensor | None = None  # (H, W) float32 its one-sigma spread


@dataclass(frozen=True, slots=True, eq=False)
class RayTargets:
    """What R query rays should render to."""

    channel: torch.Tensor  # (R,) int64
    rgb: torch.Tensor  # (R, 3)
    depth_m: torch.Tensor  # (R,), 0 = none
    weight: torch.Tensor | None = None  # (R,) what each counts in the class loss; None = all alike


def view_from_frame(frame: PosedFrame, label_set: LabelSet, width: int) -> LabelledView:
    """Resize a frame to the working width; colours by area, depth and labels by nearest pixel.
    Depth that was computed from pictures is what the view should render to where it is sure."""
    intrinsics = working_intrinsics(frame.intrinsics, width)
    if frame.label is None:
        channel = np.full((intrinsics.height, intrinsics.width), -1, np.int64)
    else:
        channel = label_set.to_channels(resize_label(frame.label, intrinsics), f"frame seq={frame.seq}")
    depth_m = torch.tensor(resize_depth(frame, intrinsics))  # a copy: the frame's own array is read-only
    spread = resize_spread(frame, intrinsics)
    sigma_m = None if spread is None else torch.tensor(spread)
    return LabelledView(
        torch.from_numpy(resize_rgb(frame, intrinsics)).permute(2, 0, 1).float().div_(255).contiguous(),
        depth_m if sigma_m is None else depth_m * (sigma_m <= UNSURE_SPREAD * depth_m),
        torch.from_numpy(channel),
        intrinsics,
        torch.tensor(frame.T_world_camera, dtype=torch.float32),
        computed_m=None if sigma_m is None else depth_m,
        computed_sigma_m=sigma_m,
    )


def mirrored_view(view: LabelledView) -> LabelledView:
    """The view in the mirror image of the world (x to -x): left and right change sides, geometry stays consistent."""
    k = view.intrinsics
    mirror = torch.diag(view.T_world_camera.new_tensor((-1.0, 1.0, 1.0, 1.0)))
    return LabelledView(
        view.rgb.flip(-1),
        view.depth_m.flip(-1),
        view.channel.flip(-1),
        CameraIntrinsics(k.fx, k.fy, k.width - 1 - k.cx, k.cy, k.width, k.height),
        mirror @ view.T_world_camera @ mirror,
        computed_m=None if view.computed_m is None else view.computed_m.flip(-1),
        computed_sigma_m=None if view.computed_sigma_m is None else view.computed_sigma_m.flip(-1),
    )


def stack_sources(views: Sequence[LabelledView], *, with_labels: bool = False) -> SourceViews:
    """Views of one resolution as the input of ``LearnedField.encode``, and what is known of their labels if wanted."""
    spreads = [v.depth_m.new_zeros(()) if v.computed_sigma_m is None else v.computed_sigma_m for v in views]
    computed = any(v.computed_sigma_m is not None for v in views)
    return SourceViews(
        torch.stack([v.rgb for v in views]),
        torch.stack([v.depth_m if v.computed_m is None else v.computed_m for v in views]),
        torch.stack([torch.from_numpy(camera_matrix(v.intrinsics)).float() for v in views]).to(views[0].rgb.device),
        torch.stack([v.T_world_camera for v in views]),
        torch.stack([v.channel for v in views]) if with_labels else None,
        torch.stack([s.expand_as(v.depth_m) for s, v in zip(spreads, views, strict=True)]) if computed else None,
    )


def withhold_depth(sources: SourceViews, fraction: float, generator: torch.Generator) -> SourceViews:
    """Set the depth of a random fraction of the views to "none", so that the field learns to work without."""
    keep = torch.rand(len(sources.depth_m), generator=generator) >= fraction
    return replace(sources, depth_m=sources.depth_m * keep.to(sources.depth_m.device)[:, None, None])


def jitter_colours(sources: SourceViews, strength: float, generator: torch.Generator) -> SourceViews:
    """Random gain a view and channel, and gamma a view: exposure and white balance drift."""
    return replace(sources, rgb=jittered(sources.rgb, strength, generator))


def jittered(rgb: torch.Tensor, strength: float, generator: torch.Generator) -> torch.Tensor:
    """Colours (m, 3, H, W) of ``jitter_colours``."""
    count = len(rgb)
    gain = 1 + strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    tint = 1 + 0.5 * strength * (2 * torch.rand(count, 3, 1, 1, generator=generator) - 1)
    gamma = 1 + strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    rgb = (rgb.clamp_min(1e-3) ** gamma.to(rgb.device)) * (gain * tint).to(rgb.device)
    return rgb.clamp(0, 1)


def draw_pixels(
    channel: torch.Tensor, count: int, balanced_fraction: float, generator: torch.Generator, classes: int
) -> torch.Tensor:
    """Flat indices of labelled pixels (count,): partly uniform, partly with every class present equally likely."""
    flat = channel.flatten()
    labelled = (flat >= 0).nonzero()[:, 0]
    if len(labelled) == 0:
        return labelled
    uniform = labelled[torch.randint(len(labelled), (count - int(count * balanced_fraction),), generator=generator)]
    histogram = torch.bincount(flat[labelled], minlength=classes).float()
    weight = torch.where(histogram > 0, 1 / histogram.clamp_min(1), torch.zeros_like(histogram))[flat[labelled]]
    cumulative = torch.cumsum(weight.double(), 0)
    u = torch.rand(int(count * balanced_fraction), generator=generator, dtype=torch.float64) * cumulative[-1]
    balanced = labelled[torch.searchsorted(cumulative, u).clamp_max(len(labelled) - 1)]
    return torch.cat((uniform, balanced))


def query_rays(
    view: LabelledView, flat_index: torch.Tensor, *, near_m: float, far_m: float, prior: torch.Tensor | None
) -> tuple[RayBatch, RayTargets]:
    """Rays through pixels ``flat_index`` (R,), row by row, of a view, with what they should render to.
    ``prior``: (R,) depth priors in metres, 0 = none; None for none at all."""
    width = view.intrinsics.width
    pixels = torch.stack((flat_index % width, flat_index // width), dim=-1).float()
    rays = pixel_rays(pixels, view.intrinsics, view.T_world_camera, near_m=near_m, far_m=far_m, prior_depth_m=prior)
    targets = RayTargets(
        view.channel.flatten()[flat_index],
        view.rgb.flatten(1)[:, flat_index].T.contiguous(),
        view.depth_m.flatten()[flat_index],
    )
    return rays, targets


def guided_rays(
    view: LabelledView,
    flat_index: torch.Tensor,
    sampling: SamplingConfig,
    generator: torch.Generator,
    *,
    noise: float,
    withheld: float,
    samples_without_depth: int,
    blind: bool = False,
    thinning: int = 1,
) -> tuple[RayBatch, RayTargets, torch.Tensor]:
    """Rays of a training step through chosen pixels (R,), what they should render to, and sample depths (R, N).

    ``noise``: sigma of the depth prior's error as a fraction of z; computed depth has errors of its own. ``withheld``:
    how often there is no depth prior; ``blind`` = always. Without one, a ray has ``samples_without_depth``, and one ray
    in ``thinning`` is rendered.
    """
    error = 1 + noise * torch.randn(len(flat_index), generator=generator)
    blind = float(torch.rand(1, generator=generator)) < withheld or blind
    near_m, far_m = sampling.near_m, sampling.far_m
    depth_m = view.depth_m if view.computed_m is None else view.computed_m
    if blind or not bool((depth_m > 0).any()):
        rays, targets = query_rays(view, flat_index[::thinning], near_m=near_m, far_m=far_m, prior=None)
        return rays, targets, sample_inverse_depth(rays.near_m, rays.far_m, samples_without_depth, generator)
    prior = depth_m.flatten()[flat_index]
    if view.computed_m is None:
        prior = prior * error
    rays, targets = query_rays(view, flat_index, near_m=near_m, far_m=far_m, prior=prior)
    return rays, targets, sample_guided(rays, sampling if view.computed_m is None else around_computed(sampling))


def view_overlap(views: Sequence[LabelledView]) -> torch.Tensor:
    """Fraction (n, n) of what each view (row) sees that each other view (column) sees, too; 0 on the diagonal."""
    overlap = torch.zeros(len(views), len(views))
    poses = [view.T_world_camera.cpu().numpy().astype(np.float64) for view in views]
    depths = [view.depth_m.cpu().numpy() for view in views]
    for i, view in enumerate(views):
        points, measured = _points(poses[i], depths[i], view)
        for j, other in enumerate(views):
            if i != j:
                seen = visible_points(points, poses[j], other.intrinsics, depths[j], measured=measured)
                overlap[i, j] = float(seen.mean())
    return overlap


def _points(pose: Float64, depth_m: Float32, view: LabelledView) -> tuple[Float64, bool]:
    """World points (P, 3) of a thinned-out view, and whether they are its measured surface or where it might be."""
    step = max(1, view.intrinsics.width // PROBE)
    unit = unproject(np.ones_like(depth_m), view.intrinsics)[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    depth = depth_m[step // 2 :: step, step // 2 :: step].reshape(-1).astype(np.float64)
    if not (depth > 0).any():
        return transform(pose, np.concatenate([unit * z for z in GUESSED_DEPTHS_M])), False
    return transform(pose, unit[depth > 0] * depth[depth > 0, None]), True


@dataclass(frozen=True, slots=True, eq=False)
class FrameRays:
    """Pixels of F frames, P in all, frame by frame and row by row."""

    intrinsics: tuple[CameraIntrinsics, ...]  # of each frame, at working width; sizes may differ
    T_world_camera: Float32  # (F, 4, 4) float32
    first: Int64  # (F + 1,) number of each frame's first pixel
    rgb: UInt8  # (P, 3) uint8
    depth_m: Float32  # (P,) z in metres, 0 = none

    def __len__(self) -> int:
        return int(self.first[-1])

    def frame_of(self, pixels: Int64) -> Int64:
        """Number of the frame (R,) of each pixel."""
        return np.searchsorted(self.first, pixels, side="right") - 1

    def rays(self, pixels: Int64, near_m: float) -> RayBatch:
        """Rays of the world through pixels (R,), without bound behind."""
        frame = self.frame_of(pixels)
        camera = np.array([(k.fx, k.fy, k.cx, k.cy, k.width) for k in self.intrinsics])[frame]
        v, u = np.divmod(pixels - self.first[frame], camera[:, 4].astype(np.int64))
        towards = np.stack(
            ((u - camera[:, 2]) / camera[:, 0], (v - camera[:, 3]) / camera[:, 1], np.ones(len(u))), axis=1
        )
        direction = np.einsum("rij,rj->ri", self.T_world_camera[frame, :3, :3], towards.astype(np.float32))
        near, far, none = (torch.full((len(u),), x) for x in (near_m, np.inf, 0.0))
        origin = np.ascontiguousarray(self.T_world_camera[frame, :3, 3])
        return RayBatch(torch.from_numpy(origin), torch.from_numpy(direction), near, far, none)

    def colours(self, pixels: Int64) -> torch.Tensor:
        """Colours (R, 3) in [0, 1] of pixels (R,)."""
        return torch.from_numpy(self.rgb[pixels] / np.float32(255))

    def pixels_of(self, frame: int) -> Int64:
        """Numbers of all pixels of a frame, row by row."""
        return np.arange(self.first[frame], self.first[frame + 1])

    def image_size(self, frame: int) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.intrinsics[frame].height, self.intrinsics[frame].width


def frame_rays(frames: Sequence[PosedFrame], width: int) -> FrameRays:
    """The pixels of frames at a working width. Raises FrameError: no frames."""
    if not frames:
        raise FrameError("there are no frames to take rays from")
    intrinsics = tuple(working_intrinsics(f.intrinsics, width) for f in frames)
    return FrameRays(
        intrinsics,
        np.stack([f.T_world_camera for f in frames]).astype(np.float32),
        np.concatenate(([0], np.cumsum([k.width * k.height for k in intrinsics]))).astype(np.int64),
        np.concatenate([resize_rgb(f, k).reshape(-1, 3) for f, k in zip(frames, intrinsics, strict=True)]),
        np.concatenate([resize_depth(f, k).reshape(-1) for f, k in zip(frames, intrinsics, strict=True)]),
    )


def pixel_channels(frames: Sequence[PosedFrame], rays: FrameRays, label_set: LabelSet) -> torch.Tensor:
    """Class channels (P,) int64 of the frames' label images, -1 = none."""
    channels = [
        np.full(k.width * k.height, -1)
        if f.label is None
        else label_set.to_channels(resize_label(f.label, k), f"frame seq={f.seq}").ravel()
        for f, k in zip(frames, rays.intrinsics, strict=True)
    ]
    return torch.from_numpy(np.concatenate(channels)).long()


def usable_frames(frames: Sequence[PosedFrame]) -> list[PosedFrame]:
    """The frames whose poses are rigid; others are left out, with a warning that counts them."""
    good: list[PosedFrame] = []
    reasons: list[str] = []
    for frame in frames:
        try:
            check_pose(frame.T_world_camera, f"frame seq={frame.seq}")
            good.append(frame)
        except PoseError as error:
            reasons.append(str(error))
    if reasons:
        _log.warning("frames_left_out", count=len(reasons), reason=reasons[0])
    return good
