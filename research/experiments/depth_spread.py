"""Fits the spread of computed depth to rooms of training seeds: the factors in depth_from_motion/estimate.py.

Example: python -m research.experiments.depth_spread --rooms 10
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch

from research.experiments.motion_depth import Walk, room_walk
from research.scenes import TRAIN_SEEDS
from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.estimate import (
    LEAST,
    MOST,
    Agreement,
    find_agreement,
    match_terms,
    smooth_planes,
    spread_of_match,
    surface_terms,
)
from semantic_mapper.depth_from_motion.stream import choose_sources
from semantic_mapper.depth_from_motion.sweep import SweepResult, inverse_depths, sweep_and_match
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView, prepare_view
from semantic_mapper.types import Float32, UInt8

FIRST_SEED = 500  # of the training seeds
STEPS_M = (0.04, 0.08, 0.12, 0.2)
FRAMES = 16
POSE_ERROR_DEG, POSE_ERROR_M = 0.06, 0.0015
PIXELS = 1500  # of a frame
QUANTILE = 0.683
STEADY, QUICK, SLOW, TURNS = 250, 0.03, 0.005, 400  # of the fit


class Sample(NamedTuple):
    """One view as matched, and its exact depth."""

    swept: SweepResult
    agreement: Agreement
    plane: Float32
    rgb: UInt8
    truth: Float32


def jittered(walk: Walk, seed: int) -> Walk:
    """The walk with poses that are slightly off."""
    rng = np.random.default_rng(seed)
    out: Walk = []
    for frame, depth in walk:
        error = np.eye(4)
        error[:3, :3] = cv2.Rodrigues(np.radians(POSE_ERROR_DEG) * rng.standard_normal(3))[0]
        error[:3, 3] = POSE_ERROR_M * rng.standard_normal(3)
        out.append((replace(frame, T_world_camera=frame.T_world_camera @ error), depth))
    return out


def samples(walk: Walk, config: DepthFromMotionConfig, ahead: int) -> Iterator[Sample]:
    """The views of a walk, each matched with earlier ones and ``ahead`` later ones."""
    planes = inverse_depths(config.planes, config.near_m, config.far_m)
    first, step = planes[0], planes[1] - planes[0]
    views = [prepare_view(frame, config.width) for frame, _ in walk]
    for k, (_, truth) in enumerate(walk):
        view = views[k]
        others: list[PreparedView] = [*views[:k], *views[k + 1 : k + 1 + ahead]]
        sources = choose_sources(view, others, None, 2.0)
        if not sources:
            continue
        swept = sweep_and_match(view, sources, planes, None)
        agreement = find_agreement(view, 1 / (first + swept.plane * step), [v for v in views[:k] if v.estimate][-6:])
        plane = ((1 / agreement.mean_m - first) / step).astype(np.float32)
        surface = smooth_planes(plane, spread_of_match(swept, agreement), view.rgb)
        depth = 1 / (first + np.clip(surface, 0, config.planes - 1) * step)
        views[k] = replace(view, estimate=DepthEstimate(depth.astype(np.float32), np.ones_like(depth)))
        size = (view.intrinsics.width, view.intrinsics.height)
        small = cv2.resize(truth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        inside = (small > config.near_m) & (small < config.far_m)
        true_plane = np.where(inside, (1 / np.maximum(small, config.near_m) - first) / step, np.nan)
        yield Sample(swept, agreement, plane, view.rgb, true_plane.astype(np.float32))


def fit(terms: Float32, off: Float32) -> Float32:
    """Factors (n,) of terms (N, n), so that ``QUANTILE`` of the errors (N,) are within the exponential of the sum."""
    x, y = torch.from_numpy(terms), torch.log(torch.from_numpy(off) + 0.02)
    factors = torch.linalg.lstsq(x, y[:, None]).solution[:, 0].requires_grad_()
    optimiser = torch.optim.Adam([factors], lr=QUICK)
    for turn in range(TURNS):
        if turn == STEADY:
            optimiser.param_groups[0]["lr"] = SLOW
        above = y - x @ factors
        loss = torch.maximum(QUANTILE * above, (QUANTILE - 1) * above).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return factors.detach().numpy()


def main() -> None:
    """Run it, and print the factors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=10)
    count = parser.parse_args().rooms
    torch.set_num_threads(1)
    config, rng = DepthFromMotionConfig(), np.random.default_rng(0)
    planes = inverse_depths(config.planes, config.near_m, config.far_m)
    found: list[Sample] = []
    for k in range(count):
        walk = room_walk(TRAIN_SEEDS[FIRST_SEED + k], FRAMES, STEPS_M[k % len(STEPS_M)])
        walk = jittered(walk, k) if k % 2 else walk
        found += [sample for ahead in (0, 4) for sample in samples(walk, config, ahead)]
    chosen = [rng.choice(np.flatnonzero(np.isfinite(s.truth)), PIXELS) for s in found]

    def fit_all(terms: list[Float32], off: list[Float32], name: str) -> Float32:
        x = np.concatenate([t.reshape(-1, t.shape[-1])[at] for t, at in zip(terms, chosen, strict=True)])
        y = np.concatenate([o.ravel()[at] for o, at in zip(off, chosen, strict=True)])
        factors = fit(x, y)
        spread = np.exp(x @ factors)
        print(f"{name} = ({', '.join(f'{f:.2f}' for f in factors)})")
        print(f"within 1 and 2 spreads: {(y < spread).mean():.3f} {(y < 2 * spread).mean():.3f}")
        for part in np.array_split(np.argsort(spread), 8):
            print(f"  spread {np.median(spread[part]):6.2f}   68 % of errors {np.quantile(y[part], QUANTILE):6.2f}")
        return factors

    terms = [match_terms(s.swept, s.agreement) for s in found]
    factors = fit_all(terms, [np.abs(s.plane - s.truth) for s in found], "MATCHED")
    matched = [np.clip(np.exp(t @ factors), LEAST, MOST) for t in terms]
    pairs = list(zip(found, matched, strict=True))
    surfaces = [np.clip(smooth_planes(s.plane, m, s.rgb), 0, config.planes - 1) for s, m in pairs]
    step = planes[1] - planes[0]
    depths = [1 / (planes[0] + surface * step) for surface in surfaces]
    triples = list(zip(found, matched, surfaces, depths, strict=True))
    terms = [surface_terms(s.plane, u, m, s.agreement, d) for s, m, u, d in triples]
    fit_all(terms, [np.abs(u - s.truth) for s, u in zip(found, surfaces, strict=True)], "SMOOTHED")


if __name__ == "__main__":
    main()
