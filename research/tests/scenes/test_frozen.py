"""Scenes are frozen: figures of suites and training runs rest on what these seeds draw.

``python -m research.tests.scenes.test_frozen`` records again, which makes all figures of the suites void.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from research.scenes import TEST_SEEDS, TRAIN_SEEDS, CameraPathConfig, NoiseConfig, RoomConfig, room_frames
from research.scenes.aerial.views import aerial_camera, aerial_views
from research.scenes.building import building_walk
from research.scenes.klevr import klevr_camera, klevr_views
from research.scenes.moving import make_moving_room, moving_views
from research.scenes.streets.views import street_camera, street_views
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

CAMERA = CameraIntrinsics(66.0, 66.0, 47.5, 35.5, 96, 72)
RECORD = Path(__file__).with_name("frozen.json")
Picture = tuple[UInt8, UInt8 | None, Float32 | None]  # colours, classes, depth


def pictures(kind: str) -> Iterator[Picture]:
    """Two pictures of a kind of scene."""
    if kind in ("room", "varied", "people", "noisy"):
        varied = RoomConfig(variety=1.0 if kind == "varied" else 0.0, people=1.0 if kind == "people" else 0.0)
        noise = NoiseConfig() if kind == "noisy" else None
        for frame in room_frames(TRAIN_SEEDS[5], 2, CAMERA, room=varied, path=CameraPathConfig(), noise=noise):
            yield frame.rgb, frame.label, frame.depth_m
    elif kind == "building":
        visit = next(iter(building_walk(2, 4, CAMERA, hz=2.0)))
        for frame in islice(visit.frames, 2):
            yield frame.rgb, frame.label, frame.depth_m
    elif kind == "moving":
        for view in islice(moving_views(make_moving_room(TEST_SEEDS[0], 4), CAMERA), 2):
            yield view.view.rendered.rgb, view.view.rendered.label, view.view.rendered.depth_m
    else:
        views = {
            "klevr": lambda: klevr_views(3, (0, 1), klevr_camera(96)),
            "aerial": lambda: aerial_views(1, (0, 9), aerial_camera(96)),
            "streets": lambda: street_views(200_000, (0, 5), street_camera(176)),
        }[kind]
        for view in views():
            yield view.rendered.rgb, view.rendered.label, view.rendered.depth_m


def observe(kind: str) -> list[dict[str, object]]:
    """Mean colour, fractions of the classes and mean depth: equal on all machines to the digits that are compared."""
    found: list[dict[str, object]] = []
    for rgb, label, depth in pictures(kind):
        ids, counts = np.unique(np.zeros(0, np.uint8) if label is None else label, return_counts=True)
        found.append({
            "colour": [round(float(c), 1) for c in rgb.reshape(-1, 3).mean(axis=0)],
            "contrast": round(float(rgb.std()), 1),
            "classes": {str(i): round(n / rgb[..., 0].size, 3) for i, n in zip(ids.tolist(), counts, strict=True)},
            "depth_m": None if depth is None else round(float(depth.mean()), 3),
        })  # fmt: skip
    return found


KINDS = ("room", "varied", "people", "noisy", "building", "moving", "klevr", "aerial", "streets")


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_draws_what_it_drew(kind: str) -> None:
    for now, then in zip(observe(kind), json.loads(RECORD.read_text())[kind], strict=True):
        assert now["colour"] == pytest.approx(then["colour"], abs=0.3)
        assert now["contrast"] == pytest.approx(then["contrast"], abs=0.3)
        assert now["classes"] == pytest.approx(then["classes"], abs=0.003)
        assert now["depth_m"] == pytest.approx(then["depth_m"], abs=0.005)


if __name__ == "__main__":
    RECORD.write_text(json.dumps({kind: observe(kind) for kind in KINDS}, indent=1) + "\n")
