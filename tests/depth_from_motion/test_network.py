"""The network of computed depth: better than the membrane in rooms it never saw, and the same bits on any threads."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion import DepthEstimate, PreparedView, choose_sources, estimate_depth, prepare_view
from semantic_mapper.depth_from_motion.estimate import match_views
from semantic_mapper.depth_from_motion.evidence import CHANNELS
from semantic_mapper.depth_from_motion.network import DepthNetwork, default_network_path, load_network, save_network
from semantic_mapper.depth_from_motion.refine import load_refiner
from semantic_mapper.errors import WeightsError
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.scenes import VALIDATION_SEEDS, CameraPathConfig, NoiseConfig
from semantic_mapper.scenes.sequence import room_views
from semantic_mapper.types import CameraIntrinsics, Float32

CAMERA = scale_intrinsics(CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480), 320, 240)
CONFIG = DepthFromMotionConfig()
FRAMES, ROOMS = 9, 6


@functools.cache
def walk(seed: int) -> tuple[list[PreparedView], list[Float32]]:
    """Views of a room, and their exact depth at the working size."""
    noise, path = NoiseConfig(depth="none"), CameraPathConfig(step_m=0.1)
    found = list(room_views(seed, FRAMES, CAMERA, path=path, noise=noise))
    return [prepare_view(v.frame, CONFIG.width) for v in found], [v.rendered.exact_depth_m[1::2, 1::2] for v in found]


def estimate(seed: int, k: int, hint: DepthEstimate | None = None) -> DepthEstimate:
    views, _ = walk(seed)
    return estimate_depth(views[k], choose_sources(views[k], views[:k], 4, None, 2.0), CONFIG, hint)


def membrane(seed: int, k: int) -> Float32:
    views, _ = walk(seed)
    matched = match_views(views[k], choose_sources(views[k], views[:k], 4, None, 2.0), CONFIG, None, ())
    first, step = matched.inverse_depth[0], matched.inverse_depth[1] - matched.inverse_depth[0]
    return np.asarray(1 / (first + step * matched.surface), np.float32)


def error(depth_m: Float32, truth: Float32) -> float:
    return float((np.abs(depth_m - truth) / truth).mean())


def over_rooms(measure: Callable[[int, int], float]) -> np.ndarray:
    return np.array([measure(seed, k) for seed in VALIDATION_SEEDS[:ROOMS] for k in (6, 8)])


def test_it_is_better_than_the_membrane_in_rooms_it_never_saw() -> None:
    ours = over_rooms(lambda seed, k: error(estimate(seed, k).depth_m, walk(seed)[1][k]))
    plain = over_rooms(lambda seed, k: error(membrane(seed, k), walk(seed)[1][k]))
    assert ours.mean() < 0.9 * plain.mean()
    assert (ours < plain).mean() > 0.7


def test_its_spread_holds_most_errors_and_tells_sure_from_unsure() -> None:
    within, surer, others = list[float](), list[float](), list[float]()
    for seed in VALIDATION_SEEDS[:ROOMS]:
        found, truth = estimate(seed, 8), walk(seed)[1][8]
        off, spread = np.abs(found.depth_m - truth) / truth, found.sigma_m / found.depth_m
        within.append(float((off < spread).mean()))
        sure = spread < np.median(spread)
        surer.append(float(off[sure].mean()))
        others.append(float(off[~sure].mean()))
    assert 0.5 < np.mean(within) < 0.9
    assert np.mean(surer) < 0.6 * np.mean(others)


def test_a_good_hint_lowers_the_error_and_a_view_without_one_is_not_worse_than_the_membrane() -> None:
    rng = np.random.default_rng(0)

    def hinted(seed: int, k: int) -> float:
        truth = walk(seed)[1][k]
        depth = (truth * (1 + 0.03 * rng.standard_normal())).astype(np.float32)
        depth[:, :40] = 0  # what the map has not seen yet
        return error(estimate(seed, k, DepthEstimate(depth, 0.04 * depth)).depth_m, truth)

    with_hint = over_rooms(hinted)
    without = over_rooms(lambda seed, k: error(estimate(seed, k).depth_m, walk(seed)[1][k]))
    assert with_hint.mean() < 0.8 * without.mean()
    assert without.mean() < over_rooms(lambda seed, k: error(membrane(seed, k), walk(seed)[1][k])).mean()


def test_the_unit_of_length_does_not_matter() -> None:
    unit, seed, k = 3.28, VALIDATION_SEEDS[0], 8
    views, truth = walk(seed)
    hint = DepthEstimate(truth[k], 0.04 * truth[k])
    scaled: list[PreparedView] = []
    for view in views:
        pose = view.T_world_camera.copy()
        pose[:3, 3] *= unit
        scaled.append(replace(view, T_world_camera=pose))
    feet = DepthFromMotionConfig(near_m=CONFIG.near_m * unit, far_m=CONFIG.far_m * unit)
    ours = estimate_depth(views[k], views[2:k], CONFIG, hint)
    theirs = estimate_depth(scaled[k], scaled[2:k], feet, DepthEstimate(unit * hint.depth_m, unit * hint.sigma_m))
    off = np.abs(theirs.depth_m / (unit * ours.depth_m) - 1)
    assert np.quantile(off, 0.99) < 1e-3  # a pixel on the border of two planes may fall to either
    assert np.quantile(np.abs(theirs.sigma_m / (unit * ours.sigma_m) - 1), 0.99) < 1e-2


def random_network() -> DepthNetwork:
    torch.manual_seed(0)
    network = DepthNetwork()
    torch.nn.init.normal_(network.head.weight, std=0.1)
    return network


@pytest.mark.parametrize("size", [(120, 160), (45, 61)])
def test_it_computes_what_torch_does_with_the_same_bits_on_any_number_of_threads(
    size: tuple[int, int], tmp_path: Path
) -> None:
    path = tmp_path / "random.safetensors"
    save_network(random_network(), path)
    evidence = torch.randn(CHANNELS, *size, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        expected = load_network(path)(evidence[None])
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(load_refiner(path)(evidence.numpy()))
    finally:
        torch.set_num_threads(before)
    np.testing.assert_allclose(found[0].log_inverse, expected.log_inverse[0], atol=1e-5)
    np.testing.assert_allclose(found[0].spread, expected.log_spread[0].exp(), rtol=1e-4)
    for other in found[1:]:
        np.testing.assert_array_equal(other.log_inverse, found[0].log_inverse)
        np.testing.assert_array_equal(other.spread, found[0].spread)


def test_the_shipped_weights_are_small_and_of_float16() -> None:
    assert default_network_path().stat().st_size < 1_000_000
    assert sum(p.numel() for p in load_network(default_network_path()).parameters()) <= 300_000


def damaged(path: Path) -> None:
    save_network(random_network(), path)
    path.write_bytes(path.read_bytes()[:1000])


def foreign(path: Path) -> None:
    save_file({"weight": torch.zeros(3)}, path)


def other_shape(path: Path) -> None:
    network = random_network()
    network.enter = torch.nn.Conv2d(5, 16, 1)
    save_network(network, path)


def not_finite(path: Path) -> None:
    network = random_network()
    torch.nn.init.constant_(network.head.weight, float("nan"))
    save_network(network, path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "no readable weights of computed depth"),
        (damaged, "no readable weights of computed depth"),
        (foreign, "not the weights of computed depth"),
        (other_shape, "tensors of another network"),
        (not_finite, "weights that are not finite"),
    ],
)
def test_a_bad_weights_file_says_what_is_wrong_and_how_to_mend_it(
    make: Callable[[Path], None], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "depth.safetensors"
    make(path)
    with pytest.raises(WeightsError, match=f"depth.safetensors: {message}.*python -m tools.train_depth"):
        load_refiner(path)
