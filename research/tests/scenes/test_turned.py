from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from research.experiments.two_generators import compare
from research.scenes import TEST_SEEDS, RoomConfig, make_room, room_frames
from research.scenes.veneer import Grain, Veneer, reflectance, solid_noise
from research.suites.config import camera_of_width, settings_digest
from research.tests.suites.tiny import tiny_suite
from semantic_mapper.labels import ROOMS

TURNED = RoomConfig(style="turned", shadow_resolution=16)


def test_rooms_of_the_second_generator_hold_most_classes_within_their_walls() -> None:
    seen: set[int] = set()
    for seed in TEST_SEEDS[:10]:
        scene = make_room(seed, TURNED)
        low, high = scene.primitives.bounds()
        inner = scene.primitives.group > 6
        assert (low[inner] > -0.01).all() and (high[inner] < np.array(scene.size_m) + 0.01).all()
        seen |= set(scene.primitives.label.tolist())
    assert {name for name, i in zip(ROOMS.names, ROOMS.ids, strict=True) if i not in seen} == {"person"}


def test_a_seed_gives_the_same_pictures_and_another_seed_others() -> None:
    first, again, other = (
        next(islice(room_frames(seed, 2, camera_of_width(48), room=TURNED), 1, None))
        for seed in (TEST_SEEDS[0], TEST_SEEDS[0], TEST_SEEDS[1])
    )
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert (first.rgb != other.rgb).mean() > 0.5
    assert first.depth_m is not None and (first.depth_m > 0).mean() > 0.99


@pytest.mark.parametrize("exponent", [0.8, 1.5])
def test_noise_has_the_spectrum_of_photographs(exponent: float) -> None:
    plane = solid_noise(np.random.default_rng(1), exponent).mean(axis=2)
    amplitude = np.abs(np.fft.fft2(plane))
    radius = np.hypot(*np.meshgrid(*[np.fft.fftfreq(64) * 64] * 2))
    rings = np.array([2, 4, 8, 16])
    means = [amplitude[(radius >= r) & (radius < r + 1)].mean() for r in rings]
    slope = np.polyfit(np.log(rings + 0.5), np.log(means), 1)[0]
    assert slope == pytest.approx(-exponent - 0.5, abs=0.35)


def test_every_grain_mixes_the_colours_of_its_material() -> None:
    stops = np.tile(np.array(((0.1, 0.2, 0.3), (0.4, 0.4, 0.4), (0.8, 0.7, 0.6))), (len(Grain), 1, 1))
    noise = solid_noise(np.random.default_rng(0), 1.0)
    turn = np.tile(np.eye(3), (len(Grain), 1, 1))
    veneer = Veneer(np.array(list(Grain)), stops, np.full(len(Grain), 0.2), turn, noise, 1.0)
    points = np.random.default_rng(2).uniform(0, 4, (4000, 3))
    for grain in Grain:
        rgb = reflectance(veneer, points, np.full(len(points), int(grain)))
        assert (rgb >= (0.099, 0.199, 0.299)).all() and (rgb <= (0.801, 0.701, 0.601)).all()
        assert rgb.std(axis=0).min() > 0.03


def test_generators_have_records_of_their_own_and_are_compared_by_the_classes_of_both() -> None:
    plain, turned = (
        tiny_suite(),
        tiny_suite(sequence={"frames": 14, "query_pairs": 1, "pair_gap": 2, "style": "turned"}),
    )
    assert all(settings_digest(plain, part) != settings_digest(turned, part) for part in ("views", "map"))
    perfect, half = np.zeros((2, 3, 4), int), np.zeros((2, 3, 4), int)
    perfect[:, (0, 1, 2), (0, 1, 2)] = 10
    half[:, 0, 0], half[:, 0, 1], half[:, 1, 1] = 10, 10, 20  # a class fewer
    (first, second, change), iou = compare(perfect.tolist(), half.tolist())
    np.testing.assert_allclose(first, 1.0)
    np.testing.assert_allclose(second, (10 / 20 + 20 / 30) / 2)
    np.testing.assert_allclose(change, second - 1.0)
    np.testing.assert_allclose(iou, ((1, 1, np.nan), (0.5, 2 / 3, np.nan)))
