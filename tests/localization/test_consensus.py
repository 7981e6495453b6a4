"""What several sightings say together, and where that puts the map."""

import numpy as np

from semantic_mapper.geometry import make_pose, rotation_vector
from semantic_mapper.localization.relocalizer import Sighting, agreed, find_consensus, sighting
from semantic_mapper.types import Float64


def pose(x: float, y: float = 0.0, turn: float = 0.0) -> Float64:
    return make_pose((0.0, turn, 0.0), (x, y, 0.0))


def seen_at(step: float, off: Float64) -> Sighting:
    """A camera at ``step`` metres that is found ``off`` from where it is."""
    return sighting(off @ pose(step), pose(step))


def test_a_minority_and_a_group_with_a_rival_are_not_believed() -> None:
    right = [seen_at(0.1 * n, pose(0.01 * n)) for n in range(4)]
    assert not find_consensus(right).refusal
    alone = [seen_at(0.4 + n, pose(5.0 * n, 7)) for n in range(4)]
    assert not find_consensus(right + alone[:3]).refusal
    found = find_consensus(right + alone)
    assert len(found.agreeing) == 4 and found.refusal == "4 of 8 frames that were found agree, more than half have to"
    rival = [seen_at(0.1 * n, pose(2.0)) for n in range(3)]
    assert "4 frames say one thing and 3 another" in find_consensus(right + rival).refusal
    assert find_consensus(right[:2]).refusal == "2 of 3 frames agree on it"


def test_the_place_is_that_of_all_that_agree_and_one_far_off_counts_for_little() -> None:
    rng = np.random.default_rng(0)
    seen = [seen_at(0.2 * n, pose(*rng.normal(0, 0.01, 2), rng.normal(0, 0.005))) for n in range(9)]
    T = agreed([*seen, seen_at(0.5, pose(0.07, 0.0, 0.03))])
    each = [np.linalg.norm(s.T_map_world[:3, 3]) for s in seen]
    assert np.linalg.norm(T[:3, 3]) < np.median(each) and np.linalg.norm(rotation_vector(T)) < 0.005
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
