import pytest

from semantic_mapper.config import SamplingConfig
from semantic_mapper.mapping.rendering import LEAST_SHARE, RateController

PIXELS = 19_200
SAMPLING = SamplingConfig(guided=8, free_space=1)


def held(
    pace: RateController, sample_ms: float, other_ms: float, frames: int = 30
) -> tuple[float, SamplingConfig, float]:
    """Fraction, sampling and time of a frame after some frames on a machine of this speed."""
    fraction, sampling = pace.choose(PIXELS)
    for _ in range(frames):
        rays = round(fraction * PIXELS)
        pace.note(rays * sampling.guided * sample_ms, other_ms, rays, sampling.guided)
        fraction, sampling = pace.choose(PIXELS)
    return fraction, sampling, round(fraction * PIXELS) * sampling.guided * sample_ms + other_ms


def test_a_slower_one_gives_up_rays_first_and_holds_the_rate():
    fraction, sampling, ms = held(RateController(5, 0.5, SAMPLING), 0.002, 60)
    assert LEAST_SHARE < fraction < 0.5
    assert sampling == SAMPLING
    assert ms == pytest.approx(180, abs=1)


def test_then_samples():
    fraction, sampling, ms = held(RateController(5, 0.5, SAMPLING), 0.01, 60)
    assert 2 <= sampling.guided < 8
    assert sampling.guided - sampling.free_space >= 2
    assert fraction >= LEAST_SHARE
    assert ms == pytest.approx(180, abs=1)
