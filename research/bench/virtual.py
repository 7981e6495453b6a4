"""Measure what virtual views bring to the maps of validation rooms, and what the same time brings otherwise."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace as with_fields
from numpy.typing import NDArray

from research.evaluation.room_map import NEAR_M, in_rooms, true_surface
from research.scenes import VALIDATION_SEEDS, CameraPathConfig, NoiseConfig, make_room, room_frames
from research.suites.config import MAP_WIDTH, SequenceConfig, camera_of_width
from semantic_mapper.config import MapperConfig, with_quality
from semantic_mapper.evaluation.metrics import ConfusionMatrix, calibration, confusion_of, nearest_labels
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float32, PosedFrame, UInt8

FRAMES = 40  # of a room
FINER = {"ray_fraction": 0.6, "guided": 8}  # twice the rays and samples of the "balanced" quality


class Coverage(NamedTuple):
    """Which frames of a room are mapped, and which of those are rendered; the others are fused without classes.

    Args:
        name: For the table.
        every: Every n-th frame is mapped.
        rendered: Every n-th of those is rendered.
        more: The same where more time is spent on rendering; 0 = that is not measured.
    """

    name: str
    every: int
    rendered: int
    more: int


COVERAGES = (
    Coverage("all", 1, 1, 0),
    Coverage("every 2nd", 2, 1, 0),
    Coverage("every 4th rendered", 1, 4, 2),
)


@dataclass(slots=True, eq=False)
class Tally:
    """Sums over rooms, at the maps' own surface points."""

    confusion: ConfusionMatrix = field(default_factory=lambda: ConfusionMatrix(ROOMS))
    voted_before: ConfusionMatrix = field(default_factory=lambda: ConfusionMatrix(ROOMS))
    points: int = 0
    voted: int = 0
    cpu_s: float = 0.0
    views: int = 0
    confidence: list[Float32] = field(default_factory=list)
    right: list[NDArray[np.bool_]] = field(default_factory=list)

    def row(self) -> dict[str, Any]:
        """Shares, CPU seconds and the number of virtual views."""
        whole, before = self.confusion.metrics(), self.voted_before.metrics()
        found = calibration(np.concatenate(self.confidence), np.concatenate(self.right))
        return {
            "miou": whole.miou,
            "accuracy": whole.total_accuracy,
            "miou_where_plain_votes": before.miou,
            "voted": self.voted / self.points,
            "ece": found.ece,
            "cpu_s": round(self.cpu_s, 2),
            "views": self.views,
        }


def bench_virtual(weights: Path | None, config: MapperConfig, rooms: int = 4, views: int = 8) -> dict[str, Any]:
    """Map validation rooms with and without virtual views, whose number is at most ``views`` a room, after all frames.

    For comparison, the time of virtual views can go into more rays and samples of the frames ("finer"), or, where not
    all frames are rendered, into rendering more of them ("more frames").

    Returns:
        Plain data: coverage -> variant -> map mIoU and accuracy (a point without votes is wrong), mIoU at the points
        that have votes without virtual views, fraction of points with votes, ECE of those, and CPU seconds of
        mapping, all rooms together.
    """
    config = with_quality(config)
    finer = with_fields(
        config,
        quality="custom",
        render=with_fields(config.render, ray_fraction=FINER["ray_fraction"]),
        sampling=with_fields(config.sampling, guided=FINER["guided"]),
    )
    tallies: dict[str, dict[str, Tally]] = {c.name: {} for c in COVERAGES}
    for seed in VALIDATION_SEEDS[:rooms]:
        every = validation_frames(seed)
        if seed == VALIDATION_SEEDS[0]:  # load what is compiled, which is no part of the seconds
            map_frames(weights, config, every[:4], 1)[0].look_around()
        for coverage in COVERAGES:
            frames = every[:: coverage.every]
            judge = Judge(seed, frames, tallies[coverage.name])
            pipeline, seconds = map_frames(weights, config, frames, coverage.rendered)
            judge.add("plain", pipeline.voxel_map, seconds)
            began = time.process_time()
            looks = pipeline.look_around(views)
            judge.add("virtual", pipeline.voxel_map, seconds + time.process_time() - began, len(looks))
            pipeline, seconds = map_frames(weights, finer, frames, coverage.rendered)
            judge.add("finer", pipeline.voxel_map, seconds)
            if coverage.more:
                pipeline, seconds = map_frames(weights, config, frames, coverage.more)
                judge.add("more frames", pipeline.voxel_map, seconds)
    return {
        "rooms": rooms,
        "frames": FRAMES,
        "views": views,
        "coverages": {name: {k: t.row() for k, t in rows.items()} for name, rows in tallies.items()},
    }


def validation_frames(seed: int) -> list[PosedFrame]:
    """The frames of a validation room that its maps are made of."""
    path = CameraPathConfig(step_m=SequenceConfig().step_m)
    return list(room_frames(seed, FRAMES, camera_of_width(MAP_WIDTH), path=path, noise=NoiseConfig()))


def map_frames(
    weights: Path | None, config: MapperConfig, frames: Sequence[PosedFrame], rendered: int
) -> tuple[MappingPipeline, float]:
    """Map frames, of which every ``rendered``-th is rendered; the seconds of CPU time that those took."""
    pipeline = Mapper.load(weights, config).pipeline
    seconds = 0.0
    for number, frame in enumerate(frames):
        assert frame.depth_m is not None
        if number % rendered:
            pipeline.voxel_map.integrate(frame, frame.depth_m, None)
            continue
        began = time.process_time()
        pipeline.step(replace(frame, label=None))
        seconds += time.process_time() - began
    return pipeline, seconds


class Judge:
    """Compares maps of one room, all of the same surface points, with the room."""

    def __init__(self, seed: int, frames: Sequence[PosedFrame], tallies: dict[str, Tally]) -> None:
        self._surface = true_surface(make_room(seed), [f.T_world_camera for f in frames])
        self._tallies = tallies
        self._truth: UInt8 | None = None
        self._plain: NDArray[np.bool_] | None = None

    def add(self, variant: str, voxel_map: VoxelMap, seconds: float, views: int = 0) -> None:
        """Count a map in; the first one says where there are votes without virtual views."""
        tally = self._tallies.setdefault(variant, Tally())
        points = voxel_map.points()
        label = in_rooms(points.label, voxel_map.label_set)
        voted = points.confidence > 0
        if self._truth is None or self._plain is None:
            surface = self._surface
            self._truth = nearest_labels(points.xyz, surface.xyz, surface.label, ROOMS, max_distance_m=NEAR_M)
            self._plain = voted
        truth = self._truth
        tally.confusion += confusion_of(truth, label, ROOMS, variant)
        before = np.where(self._plain, truth, ROOMS.ignore_id).astype(np.uint8)
        tally.voted_before += confusion_of(before, label, ROOMS, variant)
        answered = voted & (truth != ROOMS.ignore_id)
        tally.points += len(voted)
        tally.voted += int(voted.sum())
        tally.cpu_s += seconds
        tally.views += views
        tally.confidence.append(points.confidence[answered])
        tally.right.append(label[answered] == truth[answered])
