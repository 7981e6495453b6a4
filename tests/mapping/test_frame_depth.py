"""Rooms mapped without a depth sensor: where the surface lies, and what the map says of how it knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from research.scenes import TRAIN_SEEDS, room_frames
from semantic_mapper.config import DepthConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import streaming
from semantic_mapper.fields.sray import SRay
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.frame_depth import (
    GUESS_TRUST,
    MOST_SPREAD,
    MOST_TRUST,
    SURE_SPREAD,
    computed_trust,
    rendered_trust,
)
from semantic_mapper.mapping.fusion import COMPUTED_CAP, COMPUTED_LOOK, MEASURED, SURFACE_WEIGHT
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame
from tests.mapping.rendered_views import frame as posed
from tests.mapping.rendered_views import plane_depth, small_map
from tests.small import SMALL_ENCODER, SMALL_MODEL, tiny_config, tiny_pipeline

CAMERA = CameraIntrinsics(110.0, 110.0, 79.5, 59.5, 160, 120)
FINE = CameraIntrinsics(220.0, 220.0, 159.5, 119.5, 320, 240)


@cache
def walk(camera: CameraIntrinsics = CAMERA) -> tuple[PosedFrame, ...]:
    """Frames with exact depth, 8 cm apart."""
    return tuple(room_frames(TRAIN_SEEDS[7], 16, camera))


def without_depth(frames: Sequence[PosedFrame]) -> list[PosedFrame]:
    return [replace(frame, depth_m=None) for frame in frames]


def make_pipeline(**changes: object) -> MappingPipeline:
    return tiny_pipeline(**{"render": {"encode_width": 96, "scale": 0.25}, **changes})


def mapped(frames: Sequence[PosedFrame], **changes: object) -> MappingPipeline:
    pipeline = make_pipeline(**changes)
    for frame in frames:
        pipeline.step(frame)
    return pipeline


def true_surface(frames: Sequence[PosedFrame]) -> cKDTree:
    clouds: list[Float64] = []
    for frame in frames:
        assert frame.depth_m is not None
        known = frame.depth_m > 0
        clouds.append(transform(frame.T_world_camera, unproject(frame.depth_m, frame.intrinsics)[known]))
    return cKDTree(np.concatenate(clouds))


@pytest.mark.parametrize(
    ("refined", "off_m"), [(False, 0.04), (True, 0.08)]
)  # the poses are exact: refining only harms
def test_a_walk_without_depth_makes_a_surface_near_the_true_one_and_says_that_it_is_computed(
    refined: bool, off_m: float
) -> None:
    pipeline = mapped(without_depth(walk(FINE)), depth=DepthConfig(refine_poses=refined))
    points = pipeline.voxel_map.points()
    assert len(points.xyz) > 3000
    assert points.measured is not None and not points.measured.any()
    mesh = pipeline.voxel_map.mesh()
    assert mesh.measured is not None and len(mesh.measured) == len(mesh.vertices) and not mesh.measured.any()
    assert np.median(true_surface(walk(FINE)).query(points.xyz)[0]) < off_m  # of voxels of 5 cm
    assert 0 < pipeline.voxel_map.block_state()["weight"].max() <= COMPUTED_CAP


@pytest.mark.parametrize("learned", [False, True])
def test_computed_depth_is_shown_to_an_encoder_that_has_learned_from_it_and_to_no_other(learned: bool) -> None:
    encoder = msgspec.structs.replace(SMALL_ENCODER, computed_depth=learned)
    torch.manual_seed(0)
    field = SRay(msgspec.structs.replace(SMALL_MODEL, encoder=encoder), ROOMS).eval()
    pipeline = MappingPipeline(tiny_config(), streaming(field), ROOMS)
    frame = next(f for f in walk() if f.depth_m is not None)
    assert frame.depth_m is not None

    def features(shown: PosedFrame) -> np.ndarray:
        return pipeline.encode_anchor(shown).encoded.feature

    computed = features(replace(frame, depth_sigma_m=0.02 * frame.depth_m))
    assert np.array_equal(computed, features(frame if learned else replace(frame, depth_m=None)))
    assert not np.array_equal(computed, features(replace(frame, depth_m=None) if learned else frame))


@pytest.mark.parametrize(
    ("source", "computed"), [("auto", False), ("computed", True), ("sensor", False), ("off", False)]
)
def test_depth_of_a_sensor_is_used_unless_the_settings_say_otherwise(source: str, computed: bool) -> None:
    pipeline = make_pipeline(depth={"source": source})
    ready = [frame for f in walk()[:4] for frame in pipeline.prepare(f)]
    assert [frame.depth_sigma_m is not None for frame in ready] == [computed] * 4
    same = [np.array_equal(a.depth_m, b.depth_m) for a, b in zip(ready, walk(), strict=False)]
    assert same == [source in ("auto", "sensor")] * 4
    (blind,) = pipeline.prepare(without_depth(walk()[4:5])[0])
    assert (blind.depth_m is not None) == (source in ("auto", "computed"))


def test_frames_that_wait_for_later_ones_come_once_and_in_order() -> None:
    pipeline = make_pipeline(depth={"from_motion": {"delay_frames": 2}})
    frames = without_depth(walk()[:7])
    with pytest.raises(ConfigError, match="give step what prepare returns"):
        pipeline.step(frames[0])
    assert pipeline.voxel_map.block_count == 0
    ready = [[frame.seq for frame in pipeline.prepare(f)] for f in frames]
    assert ready == [[], [], [0], [1], [2], [3], [4]]
    rest = pipeline.prepare_rest()
    assert [frame.seq for frame in rest] == [5, 6] and not pipeline.prepare_rest()
    assert all(frame.depth_sigma_m is not None for frame in rest)
    assert pipeline.step(rest[0]).seq == 5


def test_trust_is_the_inverse_variance_and_nothing_where_little_is_known() -> None:
    spread = np.array([[0.0, SURE_SPREAD, 2 * SURE_SPREAD, 0.99 * MOST_SPREAD, MOST_SPREAD, 1.0]], np.float32)
    depth = np.full_like(spread, 2.0)
    expected = [[1, 1, 0.25, (SURE_SPREAD / 0.99 / MOST_SPREAD) ** 2, 0, 0]]
    np.testing.assert_allclose(computed_trust(depth, spread * depth), expected, rtol=1e-5)
    assert not computed_trust(np.zeros_like(depth), spread).any()


def test_rendered_depth_is_trusted_most_where_the_map_agrees_little_beyond_it_and_nowhere_at_edges() -> None:
    depth = slanted()
    known = depth.copy()
    known[:, :80] = 0
    trust = rendered_trust(depth, known, TRUNCATION_M)[2:-2, 2:-2]
    np.testing.assert_allclose(trust[:, 90:], MOST_TRUST, rtol=0.02)
    np.testing.assert_allclose(trust[:, :70], GUESS_TRUST, rtol=0.02)
    depth[:, 100:] += 0.3
    depth[50, 40] = 0
    trust = rendered_trust(depth, depth, TRUNCATION_M)
    assert not trust[:, 99:101].any() and not trust[49:52, 40].any() and not trust[50, 39:42].any()
    assert (trust[10:40, 20:90] > 0.4).all()


TRUNCATION_M = 0.08
POSE = np.eye(4)


def slanted() -> np.ndarray:
    return plane_depth(POSE, (0.2, 0.1, 1.0), 2.0)


def test_one_measurement_outweighs_all_that_was_computed_and_is_then_left_alone() -> None:
    near, far = plane_depth(POSE, (0.0, 0.0, 1.0), 1.0), plane_depth(POSE, (0.0, 0.0, 1.0), 1.04)
    voxel_map = small_map()
    for seq in range(40):
        voxel_map.integrate(posed(seq=seq), near, None, measured=False)
    voxel_map.integrate(posed(seq=40), far, None)
    points = voxel_map.points()
    assert points.measured.mean() > 0.9 and np.median(points.xyz[:, 2]) > 1.02
    before = voxel_map.block_state()
    voxel_map.integrate(posed(seq=41, rgb=200), near, None, measured=False)
    after = voxel_map.block_state()
    old = before["weight"] >= MEASURED
    assert old.any()
    for name in ("tsdf", "weight", "color"):
        assert before[name][old].tobytes() == after[name][old].tobytes(), name


def test_computed_depth_adds_to_a_measured_map_and_leaves_it_as_it_is() -> None:
    half = len(walk()) // 2
    pipeline = mapped(walk()[:half])
    before = pipeline.voxel_map.block_state()
    for frame in without_depth(walk()[half:]):
        pipeline.step(frame)
    after = pipeline.voxel_map.block_state()
    rows = {tuple(key): row for row, key in enumerate(after["keys"].tolist())}
    here = [rows[tuple(key)] for key in before["keys"].tolist()]
    measured = before["weight"] >= MEASURED
    assert measured.sum() > 10_000
    for name in ("tsdf", "weight", "color"):
        assert after[name][here][measured].tobytes() == before[name][measured].tobytes(), name
    new = (after["weight"] > 0) & (after["weight"] < MEASURED)
    assert new.any(), "what the first half has not seen is computed"
    said = pipeline.voxel_map.points().measured
    assert said is not None and 0.1 < said.mean() < 1
    view = pipeline.voxel_map.ray_cast(walk()[0].T_world_camera, CAMERA)
    assert view.measured is not None and view.measured[view.depth_m > 0].mean() > 0.9


def test_any_number_of_computed_looks_weighs_less_than_one_measurement() -> None:
    depth = slanted()
    voxel_map = small_map()
    for seq in range(40):
        voxel_map.integrate(posed(seq=seq), depth, None, trust=np.full_like(depth, MOST_TRUST), measured=False)
        if seq < 2:
            assert voxel_map.block_state()["weight"].max() == (seq + 1) * COMPUTED_LOOK
            assert bool(len(voxel_map.points().xyz)) == ((seq + 1) * COMPUTED_LOOK >= SURFACE_WEIGHT)
    assert voxel_map.block_state()["weight"].max() == COMPUTED_CAP < MEASURED
    assert not voxel_map.points().measured.any()
