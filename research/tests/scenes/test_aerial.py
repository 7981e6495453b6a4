"""AERIAL towns: they follow from seed and number, hold what they should, and their truth is true."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from research.scenes.aerial.town import make_town
from research.scenes.aerial.views import (
    aerial_camera,
    aerial_pose,
    aerial_views,
    cached_town,
    held_out_numbers,
    labelled_numbers,
    primitives_seen,
    training_numbers,
)
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import CARLA

CAMERA = aerial_camera(64)
SEED = 3
# Of what a change may not touch unless it raises ``AERIAL_VERSION``.
DIGEST_OF_VERSION_3 = "99c0da293a869c6a79d59fdb8efd9dc53a327c55de01d4690dc3ce93015c3c28"


def test_towns_are_those_of_this_version() -> None:
    digest = hashlib.sha256()
    for seed in (0, 7, 200_001):
        town = make_town(seed)
        p = town.scene.primitives
        for whole in (p.shape, p.label, p.group, p.material):
            digest.update(np.ascontiguousarray(whole, np.int64).tobytes())
        for real in (p.center, p.half, p.rotation, aerial_pose(town, 3), aerial_pose(town, 104)):
            digest.update(np.round(real * 1e4).astype(np.int64).tobytes())
    assert digest.hexdigest() == DIGEST_OF_VERSION_3


def test_a_view_is_the_same_whichever_others_are_rendered() -> None:
    alone = next(aerial_views(SEED, [5], CAMERA))
    among = list(aerial_views(SEED, [2, 5], CAMERA))[1]
    assert np.array_equal(alone.frame.rgb, among.frame.rgb) and alone.frame.seq == among.frame.seq == 5
    assert alone.frame.depth_m is None
    assert not np.array_equal(alone.frame.rgb, next(aerial_views(SEED + 1, [5], CAMERA)).frame.rgb)


def test_depth_and_class_of_a_view_are_those_of_the_town() -> None:
    (view,) = aerial_views(SEED, [70], CAMERA)
    xyz = transform(view.T_world_camera, unproject(view.rendered.exact_depth_m, CAMERA))
    heights = {name: np.median(xyz[view.frame.label == CARLA.id_of(name), 2]) for name in ("roads", "water")}
    assert heights["roads"] == pytest.approx(0.04, abs=0.01) and heights["water"] == pytest.approx(-1.6, abs=0.01)
    index = primitives_seen(SEED, 70, CAMERA)
    assert np.array_equal(cached_town(SEED).scene.primitives.label[index], view.frame.label)


def test_labelled_views_are_training_views_all_round_the_town() -> None:
    assert not set(training_numbers()) & set(held_out_numbers())
    assert (len(training_numbers()), len(held_out_numbers())) == (80, 20)
    town = cached_town(SEED)
    chosen = [tuple(labelled_numbers(SEED, choice, 4)) for choice in range(6)]
    assert len(set(chosen)) > 1
    for numbers in chosen:
        assert len(set(numbers)) == 4 and set(numbers) <= set(training_numbers())
        place = np.array([aerial_pose(town, n)[:2, 3] for n in numbers])
        azimuth = np.sort(np.arctan2(place[:, 1], place[:, 0]))
        gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
        assert gaps.max() < np.pi + 0.3  # two sectors of a quarter each, and what a bent flight adds
