"""Colour and small texture must not give the classes away: two classifiers that see no more than that have to fail."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from research.scenes import (
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    CameraPathConfig,
    NoiseConfig,
    RoomConfig,
    RoomView,
    room_views,
)
from semantic_mapper.evaluation.metrics import ConfusionMatrix, SegmentationMetrics
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics, Float64

CAMERA = CameraIntrinsics(110.3, 110.3, 79.5, 59.5, 160, 120)
PATCH = 7
PIXELS_A_VIEW = 500
MIDDLE = [24, 73, 122]  # red, green and blue of the middle pixel in a flat (3, 7, 7) patch


@dataclass(frozen=True)
class Samples:
    """patch (N, 147) in [-1, 1], place (N, 4): height, depth and the upper and lower neighbour's; channel (N,)."""

    patch: torch.Tensor
    place: torch.Tensor
    channel: torch.Tensor


def draw(seeds: range, views: int) -> Samples:
    """Random pixels of rooms, with what surrounds them."""
    patches, places, channels = [], [], []
    room, path = RoomConfig(shadow_resolution=32), CameraPathConfig(step_m=0.6)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for view in room_views(seed, views, CAMERA, room=room, path=path, noise=NoiseConfig(depth="none")):
            padded = np.pad(view.frame.rgb, ((3, 3), (3, 3), (0, 0)), mode="edge")
            windows = np.lib.stride_tricks.sliding_window_view(padded, (PATCH, PATCH), (0, 1))  # H W 3 7 7
            v, u = rng.integers(3, CAMERA.height - 3, PIXELS_A_VIEW), rng.integers(0, CAMERA.width, PIXELS_A_VIEW)
            patches.append(windows[v, u].reshape(PIXELS_A_VIEW, -1))
            height = heights(view)
            places.append(
                np.stack((height[v, u], view.rendered.exact_depth_m[v, u], height[v - 3, u], height[v + 3, u]), 1)
            )
            channels.append(ROOMS.to_channels(view.rendered.label[v, u]))
    return Samples(
        torch.from_numpy(np.concatenate(patches)).float() / 127.5 - 1,
        torch.from_numpy(np.concatenate(places)).float(),
        torch.from_numpy(np.concatenate(channels)),
    )


def heights(view: RoomView) -> Float64:
    """(H, W) metres above the floor."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    z = view.rendered.exact_depth_m.astype(np.float64)
    R, t = view.T_world_camera[2, :3], view.T_world_camera[2, 3]
    return R[0] * (u - CAMERA.cx) / CAMERA.fx * z + R[1] * (v - CAMERA.cy) / CAMERA.fy * z + R[2] * z + t


def best_of_mlps(
    train: tuple[torch.Tensor, torch.Tensor], test: tuple[torch.Tensor, torch.Tensor]
) -> SegmentationMetrics:
    """Figures on ``test`` (features, channels) of the better of two networks, with plain and with balanced draws."""
    results: list[SegmentationMetrics] = []
    for balance in (0.0, 0.5):
        torch.manual_seed(0)
        net = torch.nn.Sequential(
            torch.nn.Linear(train[0].shape[1], 64), torch.nn.ReLU(), torch.nn.Linear(64, 64), torch.nn.ReLU(),
            torch.nn.Linear(64, len(ROOMS)),
        )  # fmt: skip
        optimizer = torch.optim.Adam(net.parameters(), 4e-3)
        count = torch.bincount(train[1], minlength=len(ROOMS)).double()
        weight = (1 / count.clamp_min(20))[train[1]] ** balance
        rows = torch.multinomial(weight, 600 * 512, replacement=True, generator=torch.Generator().manual_seed(1))
        for batch in rows.split(512):
            optimizer.zero_grad()
            torch.nn.functional.cross_entropy(net(train[0][batch]), train[1][batch]).backward()
            optimizer.step()
        with torch.no_grad():
            predicted = net(test[0]).argmax(1).numpy()
        matrix = ConfusionMatrix(ROOMS)
        matrix.update(ROOMS.to_ids(test[1].numpy()), ROOMS.to_ids(predicted))
        results.append(matrix.metrics())
    return max(results, key=lambda metrics: metrics.miou or 0.0)


@pytest.fixture(scope="module")
def rooms() -> tuple[Samples, Samples]:
    return draw(TRAIN_SEEDS[:36], 3), draw(VALIDATION_SEEDS[:12], 3)


def test_the_colour_of_a_pixel_does_not_tell_its_class(rooms: tuple[Samples, Samples]) -> None:
    train, test = rooms
    figures = best_of_mlps((train.patch[:, MIDDLE], train.channel), (test.patch[:, MIDDLE], test.channel))
    assert figures.miou is not None
    assert figures.miou < 0.12
    leaks = {name: iou for name, iou in figures.per_class.items() if iou > 0.4 and name not in ("wall", "window")}
    assert not leaks


def test_a_patch_of_seven_by_seven_pixels_does_not_tell_its_class(rooms: tuple[Samples, Samples]) -> None:
    train, test = rooms
    figures = best_of_mlps((train.patch, train.channel), (test.patch, test.channel))
    assert figures.miou is not None
    assert figures.miou < 0.15


def test_the_same_classifier_does_much_better_where_it_is_told_height_and_depth(
    rooms: tuple[Samples, Samples],
) -> None:
    """So it is the colours that fail above, not the classifier."""
    train, test = rooms
    features = [torch.cat((s.patch[:, MIDDLE], s.place), 1) for s in (train, test)]
    colour = best_of_mlps((train.patch[:, MIDDLE], train.channel), (test.patch[:, MIDDLE], test.channel))
    told = best_of_mlps((features[0], train.channel), (features[1], test.channel))
    assert colour.miou is not None and told.miou is not None
    assert told.miou > 2 * colour.miou
