"""A room of the benchmark: what the sensor gave along a walk, and the exact truth at the query views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from research.scenes import (
    CameraPathConfig,
    NoiseConfig,
    RenderedView,
    RoomConfig,
    make_room,
    render_view,
    room_frames,
)
from research.scenes.scene import Scene
from research.scenes.shots import motion_between, sequence_shots
from research.suites.config import SuiteConfig, camera_of_width
from research.train.computed_depth import DELAY_FRAMES, ComputedDepth, compute_depth
from semantic_mapper.errors import ConfigError
from semantic_mapper.imaging import resize_depth, resize_spread
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float64, PosedFrame

CLEAN = "clean"
HARD = ("blur", "noise", "dark", "narrow", "close")  # what the query images of a room suffer from, in turn
BLUR_WAY_M = 0.05  # way of the camera while the shutter is open: five times what clean frames have at most
ISO_FACTOR = 8.0
DARK_GAIN = 0.25  # two stops
NARROW_FOCAL = 1.4  # image widths
CLOSE_M = (0.3, 0.6)  # from what is in the middle of the image
COMPUTED_SCALE = 2  # depth is computed from pictures this much larger than those that fields see, as in the mapper
AS_REPLAYED = ComputedDepth(between=1, delay_frames=DELAY_FRAMES)


@dataclass(frozen=True, slots=True, eq=False)
class BenchmarkRoom:
    """One room of the split.

    Args:
        seed: Of the room.
        template: Kind of room.
        frames: The walk, with the noise of the sensor, in the order of their ``seq``.
        given: The same with the depth that fields are given.
        label_set: Of all labels.
        truth: By frame number of each query view, in order: colour of a perfect camera at even exposure, exact depth,
            labels.
        pairs: Frame numbers of neighbouring query views by one camera.
        current: By frame number of each query view, what the camera gives there; ``frames`` has it only where clean.
        condition: By frame number of each query view, "clean" or one of ``HARD``.
    """

    seed: int
    template: str
    frames: tuple[PosedFrame, ...]
    truth: dict[int, RenderedView]
    pairs: tuple[tuple[int, int], ...]
    current: dict[int, PosedFrame]
    condition: dict[int, str]
    given: tuple[PosedFrame, ...]
    label_set: LabelSet

    def asked(self, query: int) -> PosedFrame:
        """``current`` of a query view, without label, with the depth that fields are given."""
        frame, given = self.current[query], self.given[query]
        if frame is self.frames[query]:
            return as_given(given, depth=True)
        return as_given(frame, depth=given.depth_m is not None)

    @property
    def queries(self) -> tuple[int, ...]:
        """Frame numbers of the query views."""
        return tuple(self.truth)


def make_benchmark_room(seed: int, suite: SuiteConfig) -> BenchmarkRoom:
    """Render a room; everything follows from the seed and the settings.

    Raises ConfigError: a sequence too short for its query views.
    """
    asked = suite.sequence.camera
    camera = camera_of_width(suite.tier.width, asked.focal_per_width)
    path = CameraPathConfig(
        step_m=suite.sequence.step_m,
        min_height_m=asked.min_height_m,
        max_height_m=asked.max_height_m,
        roll_deg=asked.roll_deg,
    )
    noise = NoiseConfig(depth=asked.sensor)
    furnished = RoomConfig(style=suite.sequence.style, camouflage=suite.sequence.camouflage)
    frames = tuple(room_frames(seed, suite.sequence.frames, camera, room=furnished, path=path, noise=noise))
    scene = make_room(seed, furnished)
    pairs = query_pairs(suite)
    queries = [number for pair in pairs for number in pair]
    if suite.current == "hard":
        condition = {q: HARD[(seed + turn) % len(HARD)] for turn, q in enumerate(queries)}
        current = {q: hard_frame(scene, frames, q, seed, kind, noise) for q, kind in condition.items()}
        pairs = ()  # consistency compares two views by one camera
    else:
        condition, current = dict.fromkeys(queries, CLEAN), {q: frames[q] for q in queries}
    truth = {q: render_view(scene, frame.intrinsics, frame.T_world_camera) for q, frame in current.items()}
    if suite.depth == "on":
        given = frames
    elif suite.depth == "off":
        given = tuple(replace(frame, depth_m=None) for frame in frames)
    else:
        larger = camera_of_width(COMPUTED_SCALE * suite.tier.width, asked.focal_per_width)
        walk = room_frames(seed, len(frames), larger, room=furnished, path=path, noise=noise)
        given = tuple(_with_depth(f, c) for f, c in zip(frames, compute_depth(list(walk), AS_REPLAYED), strict=True))
    return BenchmarkRoom(seed, scene.template, frames, truth, pairs, current, condition, given, scene.label_set)


def _with_depth(frame: PosedFrame, computed: PosedFrame) -> PosedFrame:
    """The frame with depth and spread of a larger picture at the same pose."""
    size = frame.intrinsics
    return replace(frame, depth_m=resize_depth(computed, size), depth_sigma_m=resize_spread(computed, size))


def hard_frame(
    scene: Scene, frames: tuple[PosedFrame, ...], query: int, seed: int, kind: str, noise: NoiseConfig
) -> PosedFrame:
    """The frame that a camera in trouble takes in the place of ``frames[query]``, with its own depth and labels.

    Args:
        scene: The room of ``seed``.
        frames: The walk; the last one is no query.
        kind: One of ``HARD``.
        noise: Of the walk.
    """
    frame = frames[query]
    pose, intrinsics = frame.T_world_camera, frame.intrinsics
    poses = np.stack([f.T_world_camera for f in frames])
    shot = sequence_shots(poses, seed, noise)[query]
    if kind == "blur":
        shot = replace(shot, T_open_close=motion_between(pose, poses[query + 1], BLUR_WAY_M))
    elif kind == "noise":
        shot = replace(shot, iso=shot.iso * ISO_FACTOR)
    elif kind == "dark":
        shot = replace(shot, gain=shot.gain * DARK_GAIN)
    elif kind == "narrow":
        intrinsics = camera_of_width(intrinsics.width, NARROW_FOCAL)
    else:
        pose = _moved_close(scene, frame, np.random.default_rng((seed, query)).uniform(*CLOSE_M))
    number = seed * 100_003 + query
    view = render_view(scene, intrinsics, pose, noise=number, noise_config=noise, shot=shot)
    depth_m = None if noise.depth == "none" else view.depth_m
    return replace(frame, rgb=view.rgb, depth_m=depth_m, label=view.label, intrinsics=intrinsics, T_world_camera=pose)


def _moved_close(scene: Scene, frame: PosedFrame, away_m: float) -> Float64:
    """The pose moved along its optical axis until the nearest thing in the middle of the image is ``away_m`` away."""
    depth_m = render_view(scene, frame.intrinsics, frame.T_world_camera).exact_depth_m
    height, width = depth_m.shape
    middle = depth_m[height // 3 : -(height // 3), width // 3 : -(width // 3)]
    pose = frame.T_world_camera.copy()
    if (middle > 0).any():
        pose[:3, 3] += pose[:3, 2] * max(0.0, float(middle[middle > 0].min()) - away_m)
    return pose


def query_pairs(suite: SuiteConfig) -> tuple[tuple[int, int], ...]:
    """Frame numbers of the query views: each pair in the middle of its fraction of the sequence.

    Raises ConfigError: no pair, or pairs that overlap.
    """
    sequence = suite.sequence
    fraction = sequence.frames / max(sequence.query_pairs, 1)
    if sequence.query_pairs < 1 or sequence.pair_gap < 1 or fraction < sequence.pair_gap + 1:
        raise ConfigError(
            f"{sequence.frames} frames do not hold {sequence.query_pairs} pairs of query views {sequence.pair_gap} "
            "apart; raise sequence.frames or lower sequence.query_pairs"
        )
    firsts = [round((p + 0.5) * fraction - sequence.pair_gap / 2) for p in range(sequence.query_pairs)]
    starts = [min(max(first, 0), sequence.frames - 1 - sequence.pair_gap) for first in firsts]
    return tuple((start, start + sequence.pair_gap) for start in starts)


def as_given(frame: PosedFrame, *, depth: bool, label: bool = False) -> PosedFrame:
    """What a field may see of a frame."""
    return replace(
        frame,
        depth_m=frame.depth_m if depth else None,
        depth_sigma_m=frame.depth_sigma_m if depth else None,
        label=frame.label if label else None,
    )
