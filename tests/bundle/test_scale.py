import numpy as np

from semantic_mapper.bundle.scale import ScaleEstimator


def test_the_scale_is_that_of_long_ways_and_follows_a_change_of_unit(rng: np.random.Generator) -> None:
    estimator = ScaleEstimator()
    place, scale = np.zeros(3), 1.7
    for step in range(100):
        place = place + 0.05 * np.array((np.cos(step / 9), np.sin(step / 9), 0.0))
        jitter = 0.002 * rng.standard_normal(3)
        estimator.add(place + jitter, place / scale)
        assert step > 10 or estimator.scale() is None
    found = estimator.scale()
    assert found is not None and abs(found / scale - 1) < 0.01
    T = np.eye(4)
    T[:3, 3] = place / scale
    estimator.rescaled(scale, T, T)
    assert abs((estimator.scale() or 0) - 1) < 0.01
    estimator.interrupt()
    estimator.add(np.full(3, 9.0), np.zeros(3))  # elsewhere in both
    assert abs((estimator.scale() or 0) - 1) < 0.01
