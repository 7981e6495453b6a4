"""A simple sensor: exposure and read noise on colour; range noise and holes at edges on depth."""

from __future__ import annotations

import numpy as np

from semantic_mapper.scenes.config import NoiseConfig
from semantic_mapper.types import Float32


def add_noise(linear: Float32, depth_m: Float32, seed: int, config: NoiseConfig) -> tuple[Float32, Float32, Float32]:
    """Exposed linear RGB (H, W, 3), depth (H, W) with noise and holes, and read noise (H, W, 3) in grey levels."""
    rng = np.random.default_rng(seed)
    gain = np.float32(2.0 ** rng.normal(0.0, config.gain_stops))
    noisy = depth_m + rng.standard_normal(depth_m.shape, np.float32) * (config.depth_sigma * depth_m * depth_m)
    holes = depth_edges(depth_m, config.edge_ratio) & (rng.random(depth_m.shape) < config.edge_hole_rate)
    valid = (depth_m > 0) & (noisy > 0) & (depth_m <= config.max_depth_m) & ~holes
    grain = rng.standard_normal(linear.shape, np.float32) * np.float32(config.rgb_sigma)
    return linear * gain, np.where(valid, noisy, 0.0).astype(np.float32), grain


def depth_edges(depth_m: Float32, ratio: float) -> np.ndarray:
    """(H, W) bool: pixels with a neighbour (4) whose depth differs by more than ``ratio`` of their own."""
    edge = np.zeros(depth_m.shape, np.bool_)
    step = np.abs(np.diff(depth_m, axis=0)) > ratio * np.minimum(depth_m[1:], depth_m[:-1])
    edge[1:] |= step
    edge[:-1] |= step
    step = np.abs(np.diff(depth_m, axis=1)) > ratio * np.minimum(depth_m[:, 1:], depth_m[:, :-1])
    edge[:, 1:] |= step
    edge[:, :-1] |= step
    return edge
