"""Where rays are sampled in streaming: round the depth prior of each, as ascending z depths (R, N) in metres."""

import msgspec
import numpy as np

from semantic_mapper.config import SamplingConfig
from semantic_mapper.types import Float32

COMPUTED_GUIDED = 8  # samples round a depth prior that was computed from pictures
COMPUTED_SIGMA = 0.05  # half width of their interval, as a fraction of depth


def guided_samples(
    prior_m: Float32, near_m: Float32 | float, far_m: Float32 | float, config: SamplingConfig
) -> Float32:
    """Samples (R, N) round the depth prior (R,) of each ray; uniform in inverse depth for rays without one (0).
    ``near_m`` and ``far_m``, of all or (R,), bound the latter. ``free_space`` of the samples lie between near and the
    guided interval: they find what stands before a prior that is out of date."""
    near, far = (np.broadcast_to(np.float32(bound), prior_m.shape)[:, None] for bound in (near_m, far_m))
    z_prior = np.where(prior_m > 0, prior_m, np.float32(1))[:, None]
    half = config.guided_sigma * z_prior + config.guided_floor_m
    start = np.maximum(z_prior - half, near * 0.5)
    around = start + np.linspace(0, 2, config.guided - config.free_space, dtype=np.float32) * half
    if config.free_space > 0:
        before = _even_in_inverse_depth(np.minimum(near, start * 0.5), start, config.free_space)
        around = np.concatenate((before, around), axis=1)
    blind = _even_in_inverse_depth(near, far, config.guided)
    return np.where(prior_m[:, None] > 0, around, blind).astype(np.float32, copy=False)


def _even_in_inverse_depth(near_m: Float32, far_m: Float32, count: int) -> Float32:
    """Midpoints of ``count`` intervals between bounds (R, 1)."""
    fraction = (np.arange(count, dtype=np.float32) + 0.5) / count
    return (1 / (1 / near_m + fraction * (1 / far_m - 1 / near_m))).astype(np.float32, copy=False)


def around_computed(config: SamplingConfig) -> SamplingConfig:
    """The settings for depth priors that were computed from pictures: these may be farther off than a sensor's."""
    return msgspec.structs.replace(
        config, guided=max(COMPUTED_GUIDED, config.guided), guided_sigma=max(COMPUTED_SIGMA, config.guided_sigma)
    )
