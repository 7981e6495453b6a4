"""Which frames a query view is rendered from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from research.suites.config import SpacingConfig
from semantic_mapper.config import KeyframeConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.geometry import LABELLED_VALUE, select_views, transform, unproject, visible_points
from semantic_mapper.mapping.keyframes import Keyframe, KeyframeStore
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

PROBE_WIDTH = 40  # pixels a row of the query that are asked what another view sees of them


@dataclass(frozen=True, slots=True)
class Sources:
    """The chosen source views of a query.

    Args:
        numbers: Positions among the candidates, the most useful first.
        distance_m: Mean distance between their camera centres and the query's.
        seen: Fraction of the query's surface that at least one of them sees.
    """

    numbers: tuple[int, ...]
    distance_m: float
    seen: float


def choose_sources(
    query_pose: Float64,
    query_depth_m: Float32,
    candidates: Sequence[PosedFrame],
    count: int,
    spacing: SpacingConfig,
    intrinsics: CameraIntrinsics | None = None,
) -> Sources:
    """The ``count`` frames that see most of what the query sees, among those that keep the distances of ``spacing``.

    Where too few do, the distance to each other is given up first, then those to the query. The choice looks at depth
    and poses alone, whatever the field is given, so that every field and every setting of depth gets the same views.
    Raises ConfigError: fewer candidates than ``count``.

    Args:
        query_pose: (4, 4) T_world_camera.
        query_depth_m: (H, W) exact z of the query view.
        candidates: Frames of one size, the query not among them; each with its sensor depth.
        count: How many to choose.
        intrinsics: Of the query; None = that of the candidates.
    """
    if len(candidates) < count:
        raise ConfigError(f"{count} source views are requested, the room has {len(candidates)} frames to choose from")
    points = _surface_points(query_pose, query_depth_m, intrinsics or candidates[0].intrinsics)
    seen = [_sees(frame, points) for frame in candidates]
    fraction = np.array([s.mean() if len(s) else 0.0 for s in seen])
    centre = np.stack([frame.T_world_camera[:3, 3] for frame in candidates])
    away = np.linalg.norm(centre - query_pose[:3, 3], axis=1)
    order = [int(i) for i in np.lexsort((np.arange(len(fraction)), away, -fraction))]
    chosen: list[int] = []
    for rule in (spacing, msgspec.structs.replace(spacing, apart_m=0.0), SpacingConfig()):
        for i in order:
            fits = rule.from_query_m <= away[i] <= rule.to_query_m
            crowded = any(float(np.linalg.norm(centre[i] - centre[j])) < rule.apart_m for j in chosen)
            if len(chosen) < count and i not in chosen and fits and not crowded:
                chosen.append(i)
    together = np.any([seen[i] for i in chosen], axis=0) if len(points) else np.zeros(1)
    return Sources(tuple(chosen), float(away[chosen].mean()), float(together.mean()))


def choose_as_mapper(past: Sequence[PosedFrame], current: PosedFrame, query_depth_m: Float32, count: int) -> Sources:
    """The keyframes that the mapper would render the current frame from, had it mapped the frames before.

    As the other choices, this one looks at sensor depth and poses alone, whatever the field is given.

    Args:
        past: All frames before the current one, at least one, each with its sensor depth.
        current: The query's frame.
        query_depth_m: (H, W) exact z of the query view.
        count: At most this many; at least one is chosen.
    """
    store = KeyframeStore(KeyframeConfig())
    nothing = torch.zeros(1, 1, 1, 1)
    encoded = EncodedViews(nothing, nothing, nothing, torch.eye(3)[None], torch.eye(4)[None], nothing)
    for number, frame in enumerate(past):
        assert frame.depth_m is not None
        if store.wants(frame.T_world_camera):
            pose = frame.T_world_camera
            store.add(Keyframe(number, frame.stamp_ns, pose, frame.intrinsics, frame.depth_m, encoded))
    depth_m = np.zeros_like(query_depth_m) if current.depth_m is None else current.depth_m
    found = store.choose(current.T_world_camera, current.intrinsics, depth_m, count)
    chosen = [keyframe.seq for keyframe in found] or [len(past) - 1]
    points = _surface_points(current.T_world_camera, query_depth_m, current.intrinsics)
    together = np.any([_sees(past[i], points) for i in chosen], axis=0) if len(points) else np.zeros(1)
    away = [np.linalg.norm(past[i].T_world_camera[:3, 3] - current.T_world_camera[:3, 3]) for i in chosen]
    return Sources(tuple(chosen), float(np.mean(away)), float(together.mean()))


def choose_covering(
    query_pose: Float64, query_depth_m: Float32, candidates: Sequence[PosedFrame], labelled: Sequence[bool], count: int
) -> Sources:
    """The frames that together show most of what the query sees: greedily, as ``coverage.cover`` does it.

    Args:
        query_pose, query_depth_m, candidates: As for ``choose_sources``.
        labelled: Of each candidate, whether it brings labels: such a view counts twice.
        count: At most this many; at least one is chosen, whatever it sees.
    """
    points = _surface_points(query_pose, query_depth_m, candidates[0].intrinsics)
    seen = np.stack([_sees(frame, points) for frame in candidates])
    value = np.where(labelled, LABELLED_VALUE, 1.0)
    chosen = select_views(seen, value, np.zeros(len(candidates)), count) or [0]
    away = [np.linalg.norm(candidates[i].T_world_camera[:3, 3] - query_pose[:3, 3]) for i in chosen]
    together = seen[chosen].any(axis=0) if len(points) else np.zeros(1)
    return Sources(tuple(chosen), float(np.mean(away)), float(together.mean()))


def _surface_points(pose: Float64, depth_m: Float32, intrinsics: CameraIntrinsics) -> Float64:
    """World points (N, 3) of a thinned-out depth image."""
    step = max(1, intrinsics.width // PROBE_WIDTH)
    points = unproject(depth_m, intrinsics)[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    return transform(pose, points[points[:, 2] > 0])


def _sees(frame: PosedFrame, points: Float64) -> NDArray[np.bool_]:
    assert frame.depth_m is not None
    return visible_points(points, frame.T_world_camera, frame.intrinsics, frame.depth_m, measured=True)
