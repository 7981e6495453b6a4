import numpy as np

from semantic_mapper.replay.sfm.colmap_process import loop_pairs
from semantic_mapper.replay.sfm.film import find_features
from semantic_mapper.types import UInt8


def test_features_are_on_pixels_whose_centres_are_integers() -> None:
    y, x = np.mgrid[:80, :100]
    blob = np.round(255 * np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 18)).astype(np.uint8)
    picture = np.repeat(blob[..., None], 3, axis=2)
    xy, descriptors = find_features(picture)
    assert np.abs(xy - (40, 30)).max(axis=1).min() < 0.3 and descriptors.dtype == np.uint8
    assert len(find_features(np.zeros((80, 100, 3), np.uint8))[0]) == 0


def test_frames_of_one_place_are_paired_across_the_film(rng: np.random.Generator) -> None:
    def place() -> UInt8:
        return rng.integers(0, 200, (240, 128)).astype(np.uint8)

    places = [place() for _ in range(10)]
    way = [*range(10), 3, 4]
    frames = [np.clip(places[p] + rng.integers(0, 12, places[p].shape), 0, 255).astype(np.uint8) for p in way]
    pairs = loop_pairs(frames, window=2, seed=1)
    assert {(3, 10), (4, 11)} <= set(pairs) and all(j - i > 2 for i, j in pairs)
    assert pairs == loop_pairs(frames, window=2, seed=1)
    assert loop_pairs([np.zeros((0, 128), np.uint8)] * 5, window=2, seed=1) == []
