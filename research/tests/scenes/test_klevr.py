"""KLEVR scenes: they follow from seed and frame, hold what they should, and their truth is true."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from research.scenes.klevr import (
    Variant,
    klevr_camera,
    klevr_pose,
    klevr_views,
    make_klevr,
)
from research.scenes.primitives import Primitives, Shape
from research.scenes.suite import SUITES
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import KLEVR

CAMERA = klevr_camera(72)
VARIANTS: tuple[Variant, ...] = ("upright", "float")
# Of what a change may not touch unless it raises ``KLEVR_VERSION``.
DIGEST_OF_VERSION_1 = "36e5a3381cfafe196c8bdc5cb7706d9bc45a34699a64ee00581aa47c8387f01e"


def test_scenes_are_those_of_this_version() -> None:
    digest = hashlib.sha256()
    for seed in (0, 7, 200_001):
        for variant in VARIANTS:
            p = make_klevr(seed, variant).primitives
            for whole in (p.shape, p.label, p.group, p.material):
                digest.update(np.ascontiguousarray(whole, np.int64).tobytes())
            for real in (p.center, p.half, p.rotation, klevr_pose(seed, 3)):
                digest.update(np.round(real * 1e4).astype(np.int64).tobytes())
    assert digest.hexdigest() == DIGEST_OF_VERSION_1


def test_a_frame_is_the_same_whichever_others_are_rendered() -> None:
    alone = next(klevr_views(4, [5], CAMERA))
    among = list(klevr_views(4, range(7), CAMERA))[5]
    assert np.array_equal(alone.frame.rgb, among.frame.rgb) and alone.frame.seq == among.frame.seq == 5
    assert np.array_equal(alone.T_world_camera, among.T_world_camera)
    assert not np.array_equal(alone.frame.rgb, next(klevr_views(5, [5], CAMERA)).frame.rgb)


@pytest.mark.parametrize("variant", VARIANTS)
def test_labels_and_depth_are_those_of_the_solids(variant: Variant) -> None:
    """Points of the depth image lie on the surface of a solid of their label, by its own equation."""
    scene = make_klevr(11, variant)
    (view,) = klevr_views(11, [2], CAMERA, variant=variant)
    depth, label = view.rendered.exact_depth_m, view.rendered.label
    p, hit = scene.primitives, depth > 0
    background = KLEVR.id_of("background")
    assert (label[~hit] == background).all() and (view.frame.rgb[~hit] == 255).all()
    points = transform(view.T_world_camera, unproject(depth, CAMERA)[hit])
    solid = p.label[np.searchsorted(p.instance, view.rendered.instance[hit])]
    assert np.array_equal(solid, label[hit])
    q = np.einsum("pij,npi->npj", p.rotation, points[:, None] - p.center) / p.half
    off = np.abs(np.stack([_outside(shape, q[:, k]) for k, shape in enumerate(p.shape)], 1))
    mine = p.instance[None] == view.rendered.instance[hit][:, None]
    assert np.where(mine, off, np.inf).min(1).max() < 1e-4
    assert 0.02 < (label != background).mean() < 0.4


def _reach(p: Primitives) -> np.ndarray:
    """How far (P, 3) boxes, cylinders and spheres (and the cylinders round tori) reach along the axes of the world."""
    along = np.abs(p.rotation * p.half[:, None])
    flat = np.hypot(along[..., 0], along[..., 1])
    round_ = np.where(p.shape[:, None] == Shape.ELLIPSOID, np.hypot(flat, along[..., 2]), flat + along[..., 2])
    return np.where(p.shape[:, None] == Shape.BOX, along.sum(-1), round_)


@pytest.mark.parametrize("name", SUITES)
def test_a_suite_gives_labelled_frames_and_scenes_of_its_own_classes(name: str) -> None:
    suite = SUITES[name]
    seeds = {split: set(seeds) for split, seeds in suite.seeds.items()}
    assert not seeds["train"] & seeds["test"] and not seeds["val"] & seeds["test"]
    first, second = suite.views(suite.seeds["val"][0], 2, klevr_camera(32))
    assert first.frame.label is not None and set(np.unique(first.frame.label)) <= {*suite.label_set.ids, 0}
    assert first.rendered.exact_depth_m.shape == (32, 32) and second.frame.stamp_ns > first.frame.stamp_ns
    assert suite.make_scene(suite.seeds["val"][0]).label_set == suite.label_set


def _outside(shape: int, q: np.ndarray) -> np.ndarray:
    """0 on the surface of the unit shape, for points (N, 3)."""
    if shape == Shape.BOX:
        return np.abs(q).max(1) - 1
    radial = np.hypot(q[:, 0], q[:, 1])
    if shape == Shape.CYLINDER:
        return np.maximum(radial, np.abs(q[:, 2])) - 1
    if shape == Shape.TORUS:
        return np.hypot((radial - 0.7) / 0.3, q[:, 2]) - 1
    return np.linalg.norm(q, axis=1) - 1
