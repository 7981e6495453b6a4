"""Depth computed from posed pictures, against a depth sensor or exact depth; one-sided and two-sided, in CPU time.

Example: python -m research.experiments.motion_depth kitchen.mcap --every 2
         python -m research.experiments.motion_depth rooms --rooms 8
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch

from research.scenes import TEST_SEEDS, CameraPathConfig, NoiseConfig
from research.scenes.sequence import room_views
from semantic_mapper.config import DepthFromMotionConfig, convert_config, read_toml
from semantic_mapper.depth_from_motion.estimate import estimate_depth
from semantic_mapper.depth_from_motion.stream import DepthFromMotion, choose_sources
from semantic_mapper.depth_from_motion.sweep import inverse_depths, sweep_and_match
from semantic_mapper.depth_from_motion.views import enlarge_estimate, prepare_view
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame

ROOM_WIDTH, ROOM_FOCAL = 320, 882.5 / 1280  # an OAK-D's lens
SIGMAS = (1.0, 2.0)  # errors within these many sigma are counted; 68 and 95 % where the spread is Gaussian
NEAREST_TRUTH_M = 1e-3

Walk = list[tuple[PosedFrame, Float32]]  # frames without depth, and what is true


class Result(NamedTuple):
    """Depth of a walk, frame by frame: those that came out with some, and of how many."""

    frames: list[tuple[PosedFrame, Float32]]
    asked: int
    cpu_ms: float


def room_walk(seed: int, count: int, step_m: float) -> Walk:
    """Pictures with the noise of a camera, exact poses, exact depth."""
    height = ROOM_WIDTH * 3 // 4
    focal = ROOM_FOCAL * ROOM_WIDTH
    camera = CameraIntrinsics(focal, focal, (ROOM_WIDTH - 1) / 2, (height - 1) / 2, ROOM_WIDTH, height)
    path, noise = CameraPathConfig(step_m=step_m), NoiseConfig(depth="none")
    return [(v.frame, v.rendered.exact_depth_m) for v in room_views(seed, count, camera, path=path, noise=noise)]


def compute(walk: Walk, config: DepthFromMotionConfig) -> Result:
    """Depth of all frames, on one thread."""
    truth = {frame.seq: depth for frame, depth in walk}
    stream, done = DepthFromMotion(config), list[PosedFrame]()
    start = time.process_time()
    for frame, _ in walk:
        done += stream.push(frame)
    done += stream.finish()
    cpu_ms = (time.process_time() - start) * 1e3 / len(walk)
    found = [(f, truth[f.seq]) for f in done if f.depth_m is not None and f.depth_m.any()]
    return Result(found, len(done), cpu_ms)


def errors(frame: PosedFrame, truth: Float32) -> dict[str, float]:
    """Figures of one frame, over the pixels whose truth is known."""
    assert frame.depth_m is not None and frame.depth_sigma_m is not None
    known = truth > NEAREST_TRUTH_M
    both = known & (frame.depth_m > 0)
    true, depth, sigma = truth[both], frame.depth_m[both], frame.depth_sigma_m[both]
    off = np.abs(depth - true)
    surer = np.argsort(sigma / depth, kind="stable")[: max(len(true) // 2, 1)]
    return {
        "density": float(both.sum() / max(known.sum(), 1)),
        "abs_rel": float((off / true).mean()),
        "median_mm": float(np.median(off)) * 1e3,
        "within_5": float((off < 0.05 * true).mean()),
        "within_10": float((off < 0.10 * true).mean()),
        "surer_half_abs_rel": float((off / true)[surer].mean()),
        "surer_half_within_5": float((off < 0.05 * true)[surer].mean()),
        "scale": float(np.median(depth / true)),
        **{f"within_{s:g}_sigma": float((off < s * sigma).mean()) for s in SIGMAS},
    }


def calibration(results: Sequence[Result], bins: int = 5) -> list[tuple[float, float]]:
    """Of pixels in order of their relative spread: median spread and 68 % quantile of the errors, fractions."""
    spread, off = list[Any](), list[Any]()
    for frame, truth in (pair for result in results for pair in result.frames):
        assert frame.depth_m is not None and frame.depth_sigma_m is not None
        both = (truth > NEAREST_TRUTH_M) & (frame.depth_m > 0)
        spread.append((frame.depth_sigma_m[both] / frame.depth_m[both])[::7])
        off.append((np.abs(frame.depth_m[both] - truth[both]) / frame.depth_m[both])[::7])
    s, e = np.concatenate(spread), np.concatenate(off)
    return [(float(np.median(s[k])), float(np.quantile(e[k], 0.683))) for k in np.array_split(np.argsort(s), bins)]


def stages(walk: Walk, config: DepthFromMotionConfig, repeats: int = 5) -> dict[str, float]:
    """CPU ms of each stage, of a frame in the middle."""
    views = [prepare_view(frame, config.width) for frame, _ in walk]
    middle, frame = len(views) // 2, walk[len(walk) // 2][0]
    reference, others = views[middle], views[max(middle - 24, 0) : middle]
    sources = choose_sources(reference, others, None, 2.0)
    planes = inverse_depths(config.planes, config.near_m, config.far_m)
    estimate = estimate_depth(reference, sources, config)
    neighbours = [replace(v, estimate=estimate) for v in others[-6:]]
    work: dict[str, Callable[[], object]] = {
        "prepare": lambda: prepare_view(frame, config.width),
        "choose sources": lambda: choose_sources(reference, others, None, 2.0),
        "sweep and match": lambda: sweep_and_match(reference, sources, planes, None),
        "estimate in all": lambda: estimate_depth(reference, sources, config, None, neighbours),
        "enlarge": lambda: enlarge_estimate(estimate, reference.rgb, frame.rgb),
    }
    found: dict[str, float] = {}
    for name, call in work.items():
        samples: list[float] = []
        for _ in range(repeats):
            start = time.process_time()
            call()
            samples.append((time.process_time() - start) * 1e3)
        found[name] = float(np.median(samples))
    return found


def report(results: Sequence[Result]) -> dict[str, Any]:
    """Means over frames of each frame's figures."""
    rows = [errors(*pair) for result in results for pair in result.frames]
    if not rows:
        return {"frames": 0, "asked": sum(r.asked for r in results)}
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    asked = sum(r.asked for r in results)
    cpu_ms = sum(r.cpu_ms * r.asked for r in results) / asked
    return {"frames": len(rows), "asked": asked, **mean, "cpu_ms": cpu_ms, "sigma_then_error": calibration(results)}


def main() -> None:
    """Run it, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", help="a log with depth of a sensor, or: rooms")
    parser.add_argument("--config", type=Path, help="TOML with settings (DepthFromMotionConfig)")
    parser.add_argument("--delay", type=int, nargs="*", default=[0, 4], help="later frames that a frame waits for")
    parser.add_argument("--every", type=int, default=1, help="of a log, use every n frames")
    parser.add_argument("--max-frames", type=int, default=0, help="of a log, 0 = all; of a room, 24 by default")
    parser.add_argument("--rooms", type=int, default=8, help="test rooms")
    parser.add_argument("--step", type=float, default=0.08, help="metres between two frames of a room")
    parser.add_argument("--json", type=Path, help="the figures, for programs")
    given = parser.parse_args()
    torch.set_num_threads(1)
    config = convert_config({} if given.config is None else read_toml(given.config), DepthFromMotionConfig, "settings")
    if given.log == "rooms":
        walks = [room_walk(seed, given.max_frames or 24, given.step) for seed in TEST_SEEDS[: given.rooms]]
    else:
        with LogReader(Path(given.log)) as log:
            frames = list(log)[:: given.every][: given.max_frames or None]
        walks = [[(replace(f, depth_m=None), f.depth_m) for f in frames if f.depth_m is not None]]
    figures: dict[str, Any] = {"stages_ms": stages(walks[0], config)}
    for delay in given.delay:
        settings = msgspec.structs.replace(config, delay_frames=delay)
        figures[f"delay {delay}"] = report([compute(walk, settings) for walk in walks])
    print(json.dumps(figures, indent=1))
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
