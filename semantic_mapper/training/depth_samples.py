"""Samples for the network of computed depth: walks through training rooms, as matching sees them, and exact depth.

Half of the walks have poses that are off, as those of recordings are; a part has a hint, as a map gives it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.estimate import match_views
from semantic_mapper.depth_from_motion.evidence import gather_evidence
from semantic_mapper.depth_from_motion.sources import choose_sources
from semantic_mapper.depth_from_motion.stream import NEIGHBOURS
from semantic_mapper.depth_from_motion.sweep import inverse_depths
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView, prepare_view
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig, RoomConfig
from semantic_mapper.scenes.sequence import room_views
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

WIDTH, HEIGHT = 320, 240
FOCALS = (0.55, 1.0)  # of the width; a part is a Kinect's
KINECT_FOCAL, KINECT = 525 / 640, 0.35
STEPS_M = (0.04, 0.06, 0.08, 0.12, 0.18)
FRAMES, VERSIONS, KEPT = 18, 2, 0.4  # pictures of a walk, versions of its poses, fraction of the views that are kept
POSES_OFF = 0.5  # fraction of the versions whose poses are
TURN_DEG, SHIFT_M = (0.03, 0.4), (0.001, 0.015)  # by which poses are off
STEADY = 0.95  # most of the error that a pose has in common with the one before
AHEAD = 4  # later views that half of the versions are matched with
HINTED, WRONG = 0.5, 0.08  # fraction of the samples with a hint; of the hints that are altogether wrong
SAME_SURFACE = 1.05
_STREAM = 12  # number of the random stream


class DepthSample(NamedTuple):
    """One view of a walk.

    Args:
        evidence: (C, h, w) float32 of ``gather_evidence``.
        truth: (h, w) float32 logarithm of the inverse depth as a fraction of the sweep's largest one.
    """

    evidence: Float32
    truth: Float32


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    frame: PosedFrame
    depth_m: Float32  # (H, W) exact


def walk_samples(seed: int) -> Iterator[DepthSample]:
    """Samples of the walk of ``seed``; everything follows from the seed."""
    rng = np.random.default_rng((_STREAM, seed))
    pictures = _pictures(seed, rng)
    for _ in range(VERSIONS):
        yield from _version(pictures, rng)


def _pictures(seed: int, rng: np.random.Generator) -> list[_Picture]:
    focal = KINECT_FOCAL if rng.uniform() < KINECT else np.exp(rng.uniform(*np.log(FOCALS)))
    camera = CameraIntrinsics(focal * WIDTH, focal * WIDTH, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
    path = CameraPathConfig(
        step_m=float(rng.choice(STEPS_M)),
        min_height_m=float(rng.uniform(0.8, 1.2)),
        tremor_deg=float(rng.uniform(0.3, 1.5)),
        roll_deg=float(rng.normal(0, 4)),
        close_up=float(rng.choice((0.0, 0.3))),
    )
    noise = NoiseConfig(depth="none", rough=0.3)
    views = room_views(seed, FRAMES, camera, room=RoomConfig(variety=0.4), path=path, noise=noise)
    return [_Picture(v.frame, v.rendered.exact_depth_m) for v in views]


def _version(pictures: list[_Picture], rng: np.random.Generator) -> Iterator[DepthSample]:
    config = DepthFromMotionConfig()
    poses = np.array([p.frame.T_world_camera for p in pictures])
    if rng.uniform() < POSES_OFF:
        poses = _off(poses, rng)
    ahead = AHEAD if rng.uniform() < 0.5 else 0
    planes = inverse_depths(config.planes, config.near_m, config.far_m)
    views = [
        prepare_view(replace(p.frame, T_world_camera=T), config.width) for p, T in zip(pictures, poses, strict=True)
    ]
    usual_m = 2.0
    for k, picture in enumerate(pictures):
        view, kept = views[k], rng.uniform() < KEPT
        truth = _reduce(picture.depth_m, view)
        hint = _map_hint(truth, rng) if kept and rng.uniform() < HINTED else None
        others = [*views[:k], *views[k + 1 : k + 1 + ahead]]
        sources = choose_sources(view, others, config.sources, None if hint is None else hint.depth_m, usual_m)
        if not sources:
            continue
        known: list[PreparedView] = [v for v in views[:k] if v.estimate is not None][-NEIGHBOURS:]
        matched = match_views(view, sources, config, hint, known)
        depth = (1 / (planes[0] + matched.surface * (planes[1] - planes[0]))).astype(np.float32)
        usual_m = float(np.median(depth))
        views[k] = replace(view, estimate=DepthEstimate(depth, np.ones_like(depth)))
        if kept:
            found = gather_evidence(view, matched, len(sources), hint)
            yield DepthSample(found, np.log(1 / (np.maximum(truth, 0.05) * planes[-1])).astype(np.float32))


def _off(poses: Float64, rng: np.random.Generator) -> Float64:
    """Poses (N, 4, 4) that are off by so much as recordings' are, each like the one before to some part."""
    turn, shift = (np.exp(rng.uniform(*np.log(bounds))) / np.sqrt(3) for bounds in (TURN_DEG, SHIFT_M))
    keep, state, out = rng.uniform(0, STEADY), rng.standard_normal(6), poses.copy()
    for k in range(len(poses)):
        state = keep * state + np.sqrt(1 - keep**2) * rng.standard_normal(6)
        error = np.eye(4)
        error[:3, :3] = cv2.Rodrigues(np.radians(turn) * state[:3])[0]
        error[:3, 3] = shift * state[3:]
        out[k] = poses[k] @ error
    return out


def _reduce(depth_m: Float32, view: PreparedView) -> Float32:
    """Depth at the view's size: the mean of 2x2 pixels of one surface, else one of them."""
    height, width = view.gray.shape
    four = depth_m.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    low, high = four.min(-1), four.max(-1)
    mean = 1 / (1 / np.maximum(four, 0.05)).mean(-1)
    return np.where(high < SAME_SURFACE * low, mean, four[..., 0]).astype(np.float32)


def _map_hint(truth: Float32, rng: np.random.Generator) -> DepthEstimate:
    """What a map would show: a few percent off, with holes, borders moved by a pixel or two, now and then wrong."""
    spread = 0.04 if rng.uniform() < 0.8 else 0.01
    smooth, fine = _blobs(truth.shape, rng, int(rng.integers(3, 9))), _blobs(truth.shape, rng, 40)
    off = spread * rng.uniform(0.2, 1.5) * (0.7 * smooth + 0.4 * fine + 0.6 * rng.standard_normal())
    if rng.uniform() < WRONG:
        off = off + rng.normal(0, 0.3)
    elif rng.uniform() < 0.3:  # a thing that was moved, or a surface that is wrong
        off = off + rng.normal(0, 0.3) * (_blobs(truth.shape, rng, 4) > 1.3)
    moved = np.roll(truth, tuple(rng.integers(-2, 3, 2)), (0, 1))
    holes = _blobs(truth.shape, rng, int(rng.integers(2, 12))) > rng.normal(0.6, 0.9)
    depth = np.where(holes, 0, moved * np.exp(off)).astype(np.float32)
    return DepthEstimate(depth, (spread * depth).astype(np.float32))


def _blobs(shape: tuple[int, ...], rng: np.random.Generator, count: int) -> Float64:
    """Smooth noise of variance of some 1 (h, w), ``count`` blobs a side."""
    coarse = rng.standard_normal((count, count))
    return np.asarray(cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float64)
