"""Structured fuzzing of a frame's values, through decoding and the whole ``MappingPipeline.step``.

Frames are small and are built value by value: ordinary ones, and ones with hostile intrinsics, poses, stamps, sizes,
depths, labels and names. A step may refuse a frame with an error of the project's own and nothing else; it may take
``MAX_STEP_S`` of CPU time, and the process may grow by ``MAX_GROWTH_MB`` after its first frames.
"""

from __future__ import annotations

import gc
import resource
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import cv2
import msgpack
import numpy as np
import torch

from semantic_mapper.config import EncoderConfig, MapperConfig, SRayConfig, convert_config
from semantic_mapper.errors import CodecError, MapError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import NYU40, ROOMS
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.memory import give_back_freed_memory
from semantic_mapper.replay.session import MapSession
from semantic_mapper.transport import codec
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

MAX_STEP_S = 2.0
MAX_GROWTH_MB = 500
WARM_UP = 300  # frames before time and memory are watched: kernels load, buffers reach their size
TRIM_EVERY = 500  # frames between two readings of the memory, with freed memory given back as the mapper does
SIZES = (
    (32, 24),
    (32, 24),
    (32, 24),
    (32, 24),
    (24, 32),
    (48, 36),
    (16, 16),
    (8, 6),
    (64, 4),
    (4, 64),
    (1, 1),
    (3, 100),
)
NUMBERS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-30, 1e-9, 0.01, 1e3, 1e5, 1e6, 1e9, 1e19, 1e38, 1e300, -1e5, -1e300)
DEPTHS = (0.0, -1.0, 1e-40, 1e-6, 0.01, 4.999, 5.0, 65.535, 1e4, 1e30, 3.4e38, np.inf, -np.inf, np.nan)
STAMPS = (0, 1, 2**31, 2**53 + 1, 2**62 - 1, 2**62, 2**62 + 1, 2**63 - 1, 2**63, 2**64 - 1, -1)
MAX_BLOCKS = 4000  # their memory is taken at the start: growth comes from elsewhere
CONFIG: dict[str, Any] = {
    "render": {"scale": 0.5, "encode_width": 32},
    "keyframes": {"capacity": 12},
    "voxel_map": {"voxel_size_m": 0.2, "max_blocks": MAX_BLOCKS},
    "history": {"max_frames": 32, "max_disk_mb": 50},
    "virtual": {"every_n_frames": 25},
}


@dataclass(slots=True)
class Report:
    """What a run found.

    Args:
        frames: Sent.
        counts: How each ended: "mapped", or why it was refused.
        restarts: Maps that were full and made way for a new one.
        slowest_s: Longest step after the first ``WARM_UP`` frames, by the clock: more on a busy machine.
        slowest_cpu_s: Most CPU time of a step, of all its threads.
        slowest: What was hostile in that one.
        growth_mb: Resident memory now against that after ``WARM_UP`` frames; ``peak_growth_mb``: the most it was.
        peak_mb: Largest resident memory of the process, from the system.
        seconds: Of the whole run.
    """

    frames: int = 0
    counts: Counter[str] = field(default_factory=Counter[str])
    restarts: int = 0
    slowest_s: float = 0.0
    slowest_cpu_s: float = 0.0
    slowest: str = ""
    growth_mb: float = 0.0
    peak_growth_mb: float = 0.0
    peak_mb: float = 0.0
    seconds: float = 0.0

    def line(self) -> str:
        """The figures on one line."""
        counts = ", ".join(f"{name} {count:,}" for name, count in self.counts.most_common())
        return (
            f"{self.frames:,} frames in {self.seconds:.0f} s ({counts}); slowest step {self.slowest_s:.2f} s "
            f"({self.slowest_cpu_s:.2f} s of CPU time), memory "
            f"grew by {self.growth_mb:.0f} MB (at most {self.peak_growth_mb:.0f} MB)"
        )

    @property
    def failures(self) -> list[str]:
        """Which limits were broken."""
        broken: list[str] = []
        if self.slowest_cpu_s > MAX_STEP_S:
            broken.append(
                f"a step took {self.slowest_cpu_s:.2f} s, at most {MAX_STEP_S:g} s are allowed: {self.slowest}"
            )
        if self.peak_growth_mb > MAX_GROWTH_MB:
            broken.append(f"memory grew by {self.peak_growth_mb:.0f} MB, at most {MAX_GROWTH_MB} MB are allowed")
        return broken


class FrameMaker:
    """Frames as the parts of a message, some of them hostile, from one seed.

    Args:
        seed: The same seed gives the same frames.
        hostile: Fraction of frames with at least one hostile value.
    """

    def __init__(self, seed: int, hostile: float = 0.6) -> None:
        self._rng = np.random.default_rng(seed)
        self._hostile = hostile
        self._seq = 0
        self._spoilers: dict[str, Callable[[dict[str, Any]], None]] = {
            "focal": self._spoil_focal,
            "center": self._spoil_center,
            "edge of the bounds": self._spoil_to_the_bounds,
            "rotation": self._spoil_rotation,
            "translation": self._spoil_translation,
            "stamp": lambda h: h.update(stamp_ns=self._pick(STAMPS)),
            "seq": lambda h: h.update(seq=self._pick(STAMPS)),
            "sigma": lambda h: h.update(pose_sigma=self._pick((*NUMBERS, np.nan, np.inf))),
            "distortion": self._spoil_distortion,
            "announced size": self._spoil_size,
        }

    def next(self) -> tuple[list[bytes], str]:
        """One message, and what is hostile in it."""
        self._seq += 1
        rng, told = self._rng, []
        size = SIZES[int(rng.integers(len(SIZES)))] if rng.random() < self._hostile else SIZES[0]
        camera = "front"
        if rng.random() < 0.02:
            camera = f"camera-{rng.integers(1000)}"
            told.append("camera")
        if size != SIZES[0]:
            camera = f"{camera}-{size[0]}x{size[1]}" if rng.random() < 0.8 else camera
            told.append(f"size {size[0]}x{size[1]}")
        frame, said = self._frame(size, camera)
        parts = codec.encode_frame(frame, codec.CodecOptions(rgb="raw"))
        told += said
        if rng.random() < self._hostile:
            header: dict[str, Any] = msgpack.unpackb(parts[1])
            for _ in range(int(rng.integers(1, 3))):
                name = str(rng.choice(list(self._spoilers)))
                self._spoilers[name](header)
                told.append(name)
            parts[1] = cast(bytes, msgpack.packb(header))
        return parts, ", ".join(told) or "ordinary"

    def _frame(self, size: tuple[int, int], camera: str) -> tuple[PosedFrame, list[str]]:
        rng, (width, height), told = self._rng, size, []
        focal = float(rng.choice((0.3, 0.69, 0.69, 0.69, 2.0))) * max(width, height)
        intrinsics = CameraIntrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.4, 3))[0]
        T[:3, 3] = rng.uniform(-1, 1, 3)
        depth = np.full((height, width), rng.uniform(0.5, 4), np.float32)
        depth += rng.normal(0, 0.005, depth.shape).astype(np.float32)
        if rng.random() < 0.3 * self._hostile:
            depth = rng.uniform(0, 5, depth.shape).astype(np.float32)
            told.append("noise for depth")
        if rng.random() < 0.5 * self._hostile:
            value = self._pick(DEPTHS)
            depth[rng.random(depth.shape) < rng.choice((0.05, 0.5, 1.0))] = value
            told.append(f"depth {value:g}")
        rgb = rng.integers(0, 256, (height, width, 3), np.uint8)
        if rng.random() < 0.1:
            rgb[:] = self._pick((0, 255))
        label = rng.integers(0, 256 if rng.random() < 0.3 else 41, (height, width)).astype(np.uint8)
        frame = PosedFrame(
            stamp_ns=10**18 + self._seq * 33_000_000,
            seq=self._seq,
            camera_id=camera,
            rgb=rgb,
            depth_m=None if rng.random() < 0.15 else depth,
            label=label if rng.random() < 0.5 else None,
            intrinsics=intrinsics,
            T_world_camera=T,
        )
        return frame, told if frame.depth_m is not None else ["no depth"]

    def _pick(self, values: tuple[Any, ...]) -> Any:
        return values[int(self._rng.integers(len(values)))]

    def _spoil_focal(self, header: dict[str, Any]) -> None:
        k, rng = header["intrinsics"], self._rng
        wide = 10.0 ** rng.uniform(-2, 3)
        both = rng.random() < 0.5
        k["fx"] = self._pick(NUMBERS) if rng.random() < 0.5 else wide * k["width"]
        k["fy"] = k["fx"] if both else (self._pick(NUMBERS) if rng.random() < 0.5 else wide * k["height"])

    def _spoil_center(self, header: dict[str, Any]) -> None:
        k, rng = header["intrinsics"], self._rng
        name, side = ("cx", "width") if rng.random() < 0.5 else ("cy", "height")
        k[name] = self._pick(NUMBERS) if rng.random() < 0.5 else float(rng.uniform(-2, 3)) * k[side]

    def _spoil_to_the_bounds(self, header: dict[str, Any]) -> None:
        """The worst camera that is accepted: widest view, centre far outside; or the longest lens."""
        k, longest = header["intrinsics"], max(header["intrinsics"]["width"], header["intrinsics"]["height"])
        if self._rng.random() < 0.7:
            k["fx"], k["fy"] = 0.1000001 * k["width"], 0.1000001 * k["height"]
        else:
            k["fx"] = k["fy"] = 99.9999 * longest
        k["cx"] = self._pick((-0.999, 0.5, 1.999)) * k["width"]
        k["cy"] = self._pick((-0.999, 0.5, 1.999)) * k["height"]

    def _spoil_rotation(self, header: dict[str, Any]) -> None:
        T, rng = np.array(header["T_world_camera"], np.float64).reshape(4, 4), self._rng
        kind = rng.integers(6)
        if kind == 0:
            T[:3, :3] *= self._pick((*NUMBERS, np.nan, np.inf))
        elif kind == 1:
            T[:3, 0] *= -1
        elif kind == 2:
            T[rng.integers(4), rng.integers(4)] = self._pick((*NUMBERS, np.nan))
        elif kind == 3:
            T[:3, :3] += rng.normal(0, 2e-4, (3, 3))  # within the tolerance
        elif kind == 4:
            T[:3, :3] = cv2.Rodrigues(rng.normal(0, 3, 3))[0]
        else:
            T[:] = rng.normal(0, 10.0 ** rng.uniform(-3, 300), (4, 4))
        header["T_world_camera"] = T.ravel().tolist()

    def _spoil_translation(self, header: dict[str, Any]) -> None:
        T, rng = np.array(header["T_world_camera"], np.float64).reshape(4, 4), self._rng
        if rng.random() < 0.5:
            T[rng.integers(3), 3] = self._pick((*NUMBERS, 99_999.0, np.inf))
        else:
            T[:3, 3] = rng.normal(0, 1, 3) * 10.0 ** rng.uniform(0, 9)
        header["T_world_camera"] = T.ravel().tolist()

    def _spoil_distortion(self, header: dict[str, Any]) -> None:
        count = int(self._rng.integers(0, 15))
        header["intrinsics"]["distortion"] = [self._pick(NUMBERS) for _ in range(count)]

    def _spoil_size(self, header: dict[str, Any]) -> None:
        header["intrinsics"][self._pick(("width", "height"))] = self._pick((0, 1, 5, 4096, 16384, 16385, 2**31, -1))


def run(frames: int, seed: int = 0, on_progress: Callable[[Report], None] | None = None) -> Report:
    """Send this many frames through a session.

    Raises Exception: whatever a step raises that is not the refusal of a frame: a bug.

    Args:
        frames: How many.
        seed: Of all values.
        on_progress: Called every ``TRIM_EVERY`` frames.
    """
    maker, report, began = FrameMaker(seed), Report(), time.monotonic()
    bundle = _bundle()
    session = _session(bundle)
    first_mb = 0.0
    for number in range(frames):
        parts, told = maker.next()
        start, start_cpu = time.perf_counter(), time.process_time()
        try:
            outcome, stages_ms = _send(session, parts)
        except MapError as error:
            if "the map is full" not in str(error):
                raise
            outcome, stages_ms, session = "the map is full", {}, _session(bundle)
            report.restarts += 1
            gc.collect()
        except Exception as error:
            error.add_note(f"frame {number} of seed {seed}: {told}")
            raise
        spent, spent_cpu = time.perf_counter() - start, time.process_time() - start_cpu
        report.frames += 1
        report.counts[outcome] += 1
        if number >= WARM_UP:
            report.slowest_s = max(report.slowest_s, spent)
        if number >= WARM_UP and spent_cpu > report.slowest_cpu_s:
            stages = {name: round(ms) for name, ms in stages_ms.items()}
            report.slowest_cpu_s = spent_cpu
            report.slowest = f"frame {number} ({told}; {outcome}; stages in ms {stages})"
        if number == WARM_UP or (number > WARM_UP and number % TRIM_EVERY == 0):
            give_back_freed_memory()
            now_mb = _resident_mb()
            first_mb = first_mb or now_mb
            report.growth_mb = now_mb - first_mb
            report.peak_growth_mb = max(report.peak_growth_mb, report.growth_mb)
            report.seconds = time.monotonic() - began
            if on_progress is not None:
                on_progress(report)
    report.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    report.seconds = time.monotonic() - began
    return report


def _bundle() -> Mapper:
    """With a small network of random weights: the values, not the quality of the map, are looked at."""
    torch.manual_seed(0)
    encoder = EncoderConfig(channels=(8, 16), blocks=(1, 1), depth=True)
    model = SRay(SRayConfig(feature_dim=16, heads=2, encoder=encoder), ROOMS).eval()
    config = convert_config(CONFIG, MapperConfig, "fuzz")
    recipe = {"kind": "random", "width": 32, "train_stamps_ns": []}
    weights = Checkpoint(model, (), recipe).weights
    pipeline = MappingPipeline(config, make_field(weights, config), ROOMS)
    return Mapper(pipeline, weights, Path("random.safetensors"))


def _session(bundle: Mapper) -> MapSession:
    """With an empty map."""
    pipeline = bundle.pipeline
    fresh = MappingPipeline(pipeline.config, pipeline.field, pipeline.label_set)
    return MapSession(replace(bundle, pipeline=fresh), stream_labels=NYU40)


def _send(session: MapSession, parts: list[bytes]) -> tuple[str, dict[str, float]]:
    """How a frame ended, and what its stages took."""
    try:
        frame = codec.decode_as(PosedFrame, parts)
    except CodecError:
        return "refused by the codec", {}
    blocks, fused = session.pipeline.voxel_map.block_count, session.pipeline.voxel_map.frames
    (update,) = session.process(frame)
    if isinstance(update, MapUpdate):
        return "mapped", update.stage_ms
    after = session.pipeline.voxel_map
    assert (after.block_count, after.frames) == (blocks, fused), "a frame was refused, but the map has changed"
    return "refused by the mapper", {}


def _resident_mb() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6
