"""A room of the benchmark: what the sensor gave along a walk, and the exact truth at the query views."""

from __future__ import annotations

from dataclasses import dataclass, replace

from semantic_mapper.benchmark.config import SuiteConfig, camera_of_width
from semantic_mapper.errors import ConfigError
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig, RenderedView, make_room, render_view, room_frames
from semantic_mapper.types import PosedFrame


@dataclass(frozen=True, slots=True, eq=False)
class BenchmarkRoom:
    """One room of the split.

    Args:
        seed: Of the room.
        template: Kind of room.
        frames: The walk, with the noise of the sensor, in the order of their ``seq``.
        truth: By frame number of each query view, in order: colour of a perfect camera at even exposure, exact depth,
            labels.
        pairs: Frame numbers of neighbouring query views.
    """

    seed: int
    template: str
    frames: tuple[PosedFrame, ...]
    truth: dict[int, RenderedView]
    pairs: tuple[tuple[int, int], ...]

    @property
    def queries(self) -> tuple[int, ...]:
        """Frame numbers of the query views."""
        return tuple(self.truth)


def make_benchmark_room(seed: int, suite: SuiteConfig) -> BenchmarkRoom:
    """Render a room; everything follows from the seed and the settings.

    Raises:
        ConfigError: a sequence too short for its query views.
    """
    asked = suite.sequence.camera
    camera = camera_of_width(suite.tier.width, asked.focal_per_width)
    path = CameraPathConfig(
        step_m=suite.sequence.step_m,
        min_height_m=asked.min_height_m,
        max_height_m=asked.max_height_m,
        roll_deg=asked.roll_deg,
    )
    frames = tuple(room_frames(seed, suite.sequence.frames, camera, path=path, noise=NoiseConfig(depth=asked.sensor)))
    scene = make_room(seed)
    pairs = query_pairs(suite)
    queries = [number for pair in pairs for number in pair]
    truth = {q: render_view(scene, camera, frames[q].T_world_camera) for q in queries}
    return BenchmarkRoom(seed, scene.template, frames, truth, pairs)


def query_pairs(suite: SuiteConfig) -> tuple[tuple[int, int], ...]:
    """Frame numbers of the query views: each pair in the middle of its fraction of the sequence.

    Raises:
        ConfigError: no pair, or pairs that overlap.
    """
    sequence = suite.sequence
    fraction = sequence.frames / max(sequence.query_pairs, 1)
    if sequence.query_pairs < 1 or sequence.pair_gap < 1 or fraction < sequence.pair_gap + 1:
        raise ConfigError(
            f"{sequence.frames} frames do not hold {sequence.query_pairs} pairs of query views {sequence.pair_gap} "
            "apart; raise sequence.frames or lower sequence.query_pairs"
        )
    firsts = [round((p + 0.5) * fraction - sequence.pair_gap / 2) for p in range(sequence.query_pairs)]
    starts = [min(max(first, 0), sequence.frames - 1 - sequence.pair_gap) for first in firsts]
    return tuple((start, start + sequence.pair_gap) for start in starts)


def as_given(frame: PosedFrame, *, depth: bool, label: bool = False) -> PosedFrame:
    """What a field may see of a frame."""
    return replace(frame, depth_m=frame.depth_m if depth else None, label=frame.label if label else None)
