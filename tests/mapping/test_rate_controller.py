import pytest

from semantic_mapper.config import SamplingConfig
from semantic_mapper.mapping.rate_controller import LEAST_SHARE, Pace

PIXELS = 19_200
SAMPLING = SamplingConfig(guided=8, free_space=1)


def held(pace: Pace, sample_ms: float, other_ms: float, frames: int = 30) -> tuple[float, SamplingConfig, float]:
    """Share, sampling and time of a frame after some frames on a machine of this speed."""
    share, sampling = pace.choose(PIXELS)
    for _ in range(frames):
        rays = round(share * PIXELS)
        pace.note(rays * sampling.guided * sample_ms, other_ms, rays, sampling.guided)
        share, sampling = pace.choose(PIXELS)
    return share, sampling, round(share * PIXELS) * sampling.guided * sample_ms + other_ms


def test_a_machine_that_is_fast_enough_renders_all_that_is_set():
    share, sampling, _ = held(Pace(5, 0.5, SAMPLING), 0.0005, 40)
    assert (share, sampling) == (0.5, SAMPLING)


def test_a_slower_one_gives_up_rays_first_and_holds_the_rate():
    share, sampling, ms = held(Pace(5, 0.5, SAMPLING), 0.002, 60)
    assert LEAST_SHARE < share < 0.5
    assert sampling == SAMPLING
    assert ms == pytest.approx(180, abs=1)


def test_then_samples():
    share, sampling, ms = held(Pace(5, 0.5, SAMPLING), 0.01, 60)
    assert 2 <= sampling.guided < 8
    assert sampling.guided - sampling.free_space >= 2
    assert share >= LEAST_SHARE
    assert ms == pytest.approx(180, abs=1)


def test_without_any_time_left_it_asks_for_the_least():
    share, sampling, _ = held(Pace(5, 0.5, SAMPLING), 0.01, 500)
    assert share == 0
    assert sampling.guided == 2


def test_it_recovers_when_the_machine_does():
    pace = Pace(5, 0.5, SAMPLING)
    held(pace, 0.01, 500)
    assert held(pace, 0.0005, 40)[:2] == (0.5, SAMPLING)


def test_a_view_without_rays_tells_nothing_of_their_cost():
    pace = Pace(5, 0.5, SAMPLING)
    pace.note(50.0, 40.0, 0, 32)
    assert pace.choose(PIXELS) == (0.5, SAMPLING)
