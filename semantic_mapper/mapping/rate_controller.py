"""Holding a rate: how many rays and samples the next frame may have, from what the last ones took."""

from __future__ import annotations

import msgspec

from semantic_mapper.config import SamplingConfig

LEAST_SAMPLES = 2
LEAST_SHARE = 0.1  # of the pixels; below, samples go first
RESERVE = 0.9  # of a frame's time is planned for: frames differ
MEMORY = 0.7  # of what was known stays when a new frame is measured


class RateController:
    """Trades rays, then samples, for a target rate.

    What a frame takes is modelled as a part that does not depend on rays, and a cost a ray and sample; both are
    followed from frame to frame. What it chooses depends on the machine, so a map made with it is not reproducible.

    Args:
        target_hz: Frames a second to hold.
        fraction: Largest fraction of the pixels that may have rays.
        sampling: The most samples a ray.
    """

    def __init__(self, target_hz: float, fraction: float, sampling: SamplingConfig) -> None:
        self._budget_ms = RESERVE * 1e3 / target_hz
        self._share = fraction
        self._sampling = sampling
        self._other_ms: float | None = None
        self._sample_ms: float | None = None  # of one sample of one ray

    def choose(self, pixels: int) -> tuple[float, SamplingConfig]:
        """Fraction of the ``pixels`` of the rendered view that may have rays, and the samples a ray."""
        if self._other_ms is None or self._sample_ms is None:
            return self._share, self._sampling
        samples = max(self._budget_ms - self._other_ms, 0.0) / self._sample_ms
        count = self._sampling.guided
        while count > LEAST_SAMPLES and samples / (count * pixels) < min(LEAST_SHARE, self._share):
            count -= 1
        free = min(self._sampling.free_space, count - LEAST_SAMPLES)
        sampling = msgspec.structs.replace(self._sampling, guided=count, free_space=free)
        return min(samples / (count * pixels), self._share), sampling

    def note(self, render_ms: float, other_ms: float, rays: int, samples: int) -> None:
        """What a frame took: its rendering, and all else."""
        self._other_ms = _follow(self._other_ms, other_ms)
        if rays:
            self._sample_ms = _follow(self._sample_ms, render_ms / (rays * samples))


def _follow(old: float | None, new: float) -> float:
    return new if old is None else MEMORY * old + (1 - MEMORY) * new
