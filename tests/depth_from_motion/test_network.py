"""The network of computed depth: better than the membrane in rooms it never saw, and the same bits on any threads."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion import DepthEstimate, PreparedView, estimate_depth, prepare_view
from semantic_mapper.depth_from_motion.evidence import CHANNELS, HINT_CHANNELS, MEMBRANE
from semantic_mapper.depth_from_motion.network import DepthNetwork, default_network_path, load_network, save_network
from semantic_mapper.depth_from_motion.refine import default_refiner, load_refiner
from semantic_mapper.errors import WeightsError
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.scenes import VALIDATION_SEEDS, CameraPathConfig, NoiseConfig
from semantic_mapper.scenes.sequence import room_views
from semantic_mapper.training.depth_samples import DepthSample, walk_samples
from semantic_mapper.types import CameraIntrinsics, Float32

CAMERA = scale_intrinsics(CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480), 320, 240)
CONFIG = DepthFromMotionConfig()
FRAMES, ROOMS = 9, 4


@functools.cache
def samples() -> list[DepthSample]:
    """Views of rooms that training never sees, half of them with poses that are off, with and without hints."""
    return [sample for seed in VALIDATION_SEEDS[:ROOMS] for sample in walk_samples(seed)]


def has_hint(sample: DepthSample) -> bool:
    return bool(sample.evidence[HINT_CHANNELS.start + 1].any())


def without_hint(sample: DepthSample) -> DepthSample:
    evidence = sample.evidence.copy()
    evidence[HINT_CHANNELS] = 0
    evidence[HINT_CHANNELS.start] = evidence[MEMBRANE]
    return DepthSample(evidence, sample.truth)


def errors(found: Sequence[Float32], given: Sequence[DepthSample]) -> np.ndarray:
    """Mean relative error of the depth of each."""
    return np.array([np.abs(np.expm1(s.truth - log)).mean() for log, s in zip(found, given, strict=True)])


def network_errors(given: Sequence[DepthSample]) -> np.ndarray:
    return errors([default_refiner()(s.evidence).log_inverse for s in given], given)


def membrane_errors(given: Sequence[DepthSample]) -> np.ndarray:
    return errors([s.evidence[MEMBRANE] for s in given], given)


@pytest.mark.parametrize("hinted", [False, True])
def test_it_is_better_than_the_membrane_in_rooms_it_never_saw(hinted: bool) -> None:
    given = [s for s in samples() if has_hint(s) == hinted]
    ours, plain = network_errors(given), membrane_errors(given)
    assert ours.mean() < 0.95 * plain.mean()
    assert (ours < plain).mean() > 0.8


def test_its_spread_holds_most_errors_and_tells_sure_from_unsure() -> None:
    within, surer, others = list[float](), list[float](), list[float]()
    for sample in samples():
        found = default_refiner()(sample.evidence)
        off = np.abs(found.log_inverse - sample.truth)
        within.append(float((off < found.spread).mean()))
        sure = found.spread < np.median(found.spread)
        surer.append(float(off[sure].mean()))
        others.append(float(off[~sure].mean()))
    assert 0.55 < np.mean(within) < 0.85
    assert np.mean(surer) < 0.5 * np.mean(others)


def test_a_hint_lowers_the_error_and_a_view_that_lost_it_is_not_worse_than_the_membrane() -> None:
    hinted = [s for s in samples() if has_hint(s)]
    bare = [without_hint(s) for s in hinted]
    assert network_errors(hinted).mean() < 0.9 * network_errors(bare).mean()
    assert network_errors(bare).mean() < membrane_errors(bare).mean()


def test_a_hint_that_is_wrong_everywhere_does_not_outweigh_the_picture() -> None:
    given = [without_hint(s) for s in samples()]
    wrong = [s.evidence.copy() for s in given]
    for evidence, sample in zip(wrong, given, strict=True):
        evidence[HINT_CHANNELS.start] = sample.truth - np.log(1.5)
        evidence[HINT_CHANNELS.start + 1], evidence[HINT_CHANNELS.start + 2] = 1, 0.25
    misled = [np.median(default_refiner()(e).log_inverse - s.truth) for e, s in zip(wrong, given, strict=True)]
    assert abs(np.median(misled)) < 0.25 * np.log(1.5)


def walk(seed: int) -> tuple[list[PreparedView], list[Float32]]:
    """Views of a room, and their exact depth at the working size."""
    noise, path = NoiseConfig(depth="none"), CameraPathConfig(step_m=0.1)
    found = list(room_views(seed, FRAMES, CAMERA, path=path, noise=noise))
    return [prepare_view(v.frame, CONFIG.width) for v in found], [v.rendered.exact_depth_m[1::2, 1::2] for v in found]


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
