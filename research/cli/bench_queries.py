"""Measure questions to a map while it is built at full rate, and what they cost the one who builds it."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from research.bench.fusion import STEP_M, WARM_UP
from research.bench.walk import wide_camera
from research.cli.bench_client import ASK, ASKING, KINDS, READY, REST, Asked, query_on_command
from research.scenes import TEST_SEEDS, CameraPathConfig, room_frames
from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import TransportError
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.query_answers import Question
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.types import PosedFrame

TURN = 5  # frames with questions, then as many without, or the other way round
HELD = 5  # frames that are mapped while an answer is withheld
PATIENCE_S = 60.0  # after which a withheld answer is given all the same


def bench_queries(
    weights: Path | None, config: MapperConfig, frames: int = 20, rate_hz: float = 20.0, width: int = 640
) -> dict[str, Any]:
    """Map frames of a test room as fast as it goes, in turns with and without another process that asks.

    The mapper does what its node does after each frame: ``step``, then ``QueryService.follow``. Where nobody asks,
    ``follow`` would do nothing, and is left out. Of two neighbouring turns, first the one and then the other comes
    first, since steps change as the map grows.

    At the end one question is asked whose answer is withheld until ``HELD`` more frames are mapped. Were there
    anything in a step or in ``follow`` that waits for an answer, the first of them could not end.

    Args:
        weights: None = those that ship with the package.
        config: Of the mapper.
        frames: That count, with questions; as many without.
        rate_hz: Questions a second, of all kinds together.
        width: Of the images, 4 : 3.

    Returns:
        Plain data. By kind of question: ``asked`` how many, and ``p50_ms``, ``p95_ms`` from asking to the decoded
        answer; ``asked_hz`` the rate that was reached. ``quiet_step_*`` and ``asked_step_*`` are a step with the
        ``follow`` after it, ``quiet_cpu_*`` and ``asked_cpu_*`` the processor time of the whole process meanwhile, with
        what it spends on answers; ``step_ratio``, ``step_p95_ratio`` and ``cpu_ratio`` are asked over quiet;
        ``follow_*`` is ``follow`` alone.
        ``longest_wait_ms`` is the longest step (with ``follow``) of those that should have ended while an answer was
        withheld and did not, 0 where all did.

    Raises:
        TransportError: the process that asks has failed.
    """
    count, path = WARM_UP + 2 * frames + HELD, CameraPathConfig(step_m=STEP_M)
    posed = list(room_frames(TEST_SEEDS[0], count, wide_camera(width), path=path))
    pipeline = Mapper.load(weights, config).pipeline
    for frame in posed[:WARM_UP]:
        pipeline.step(frame)
    eyes = np.stack([frame.T_world_camera[:3, 3] for frame in posed])
    with (
        tempfile.TemporaryDirectory(prefix="sm-") as folder,
        _HoldingService(f"ipc://{folder}/query", pipeline.voxel_map) as service,
        _asker(service, eyes, rate_hz) as asker,
    ):
        log = _map_in_turns(pipeline, posed[WARM_UP:-HELD], service, asker)
        waits = _mapped_while_held(pipeline, posed[-HELD:], service, asker)
    return {
        "size": f"{width}x{width * 3 // 4}",
        "quality": config.quality,
        "voxel_size_m": config.voxel_map.voxel_size_m,
        "threads": torch.get_num_threads(),
        "frames": frames,
        "rate_hz": rate_hz,
        **log.figures(),
        "held_steps": len(waits),
        "longest_wait_ms": round(max(waits), 1),
        "blocks": pipeline.voxel_map.block_count,
    }


class _Step(NamedTuple):
    """Milliseconds of a step with ``follow`` after it, of ``follow`` alone, and of processor time of the process."""

    ms: float
    follow_ms: float
    cpu_ms: float


@dataclass(slots=True)
class _Log:
    """What steps and questions took."""

    quiet_steps: list[_Step] = field(default_factory=list)
    asked_steps: list[_Step] = field(default_factory=list)
    asked: list[Asked] = field(default_factory=list)
    asked_s: float = 0.0

    def figures(self) -> dict[str, Any]:
        by_kind = {kind: [one.ms for one in self.asked if one.kind == kind] for kind in KINDS}
        by_kind = {kind: values for kind, values in by_kind.items() if values}
        turns = {"quiet": np.array(self.quiet_steps), "asked": np.array(self.asked_steps)}
        p50, p95 = (
            {name: np.percentile(rows, fraction, axis=0) for name, rows in turns.items()} for fraction in (50, 95)
        )
        return {
            "asked_hz": round(len(self.asked) / self.asked_s, 1),
            "asked": {kind: len(values) for kind, values in by_kind.items()},
            "p50_ms": {kind: round(float(np.percentile(values, 50)), 2) for kind, values in by_kind.items()},
            "p95_ms": {kind: round(float(np.percentile(values, 95)), 2) for kind, values in by_kind.items()},
            **{f"{name}_step_p50_ms": round(float(p50[name][0]), 1) for name in turns},
            **{f"{name}_step_p95_ms": round(float(p95[name][0]), 1) for name in turns},
            **{f"{name}_cpu_p50_ms": round(float(p50[name][2]), 1) for name in turns},
            "step_ratio": round(float(p50["asked"][0] / p50["quiet"][0]), 3),
            "step_p95_ratio": round(float(p95["asked"][0] / p95["quiet"][0]), 3),
            "cpu_ratio": round(float(p50["asked"][2] / p50["quiet"][2]), 3),
            "follow_p95_ms": round(float(p95["asked"][1]), 2),
            "follow_longest_ms": round(float(turns["asked"][:, 1].max()), 2),
        }


class _HoldingService(QueryService):
    """A query service whose next answer can be withheld."""

    def __init__(self, endpoint: str, voxel_map: VoxelMap) -> None:
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.withheld = threading.Event()
        super().__init__(endpoint, voxel_map)

    def _answer(self, question: Question) -> list[bytes]:
        if not self.may_answer.is_set():
            self.withheld.set()
            self.may_answer.wait(PATIENCE_S)
            self.may_answer.set()
        return super()._answer(question)


@dataclass(frozen=True, slots=True)
class _Asker:
    """The process that asks, as seen from here."""

    process: BaseProcess
    words: Connection
    service: QueryService

    def begin(self) -> None:
        """Let it ask; the mirror is up to date then."""
        self.words.send(ASK)
        self.expect(ASKING)

    def rest(self) -> list[Asked]:
        """Let it stop; what it has asked."""
        self.words.send(REST)
        return self._next()

    def expect(self, word: str) -> None:
        """Wait for it to say so."""
        said = self._next()
        if said != word:
            raise TransportError(f"the process that asks said {said!r} instead of {word!r}")

    def follow(self) -> None:
        """Answers may wait for the mirror, which only we can bring up to date."""
        self.service.follow()
        if not self.process.is_alive():
            raise TransportError(f"the process that asks has ended (exit code {self.process.exitcode}); see its error")

    def _next(self) -> Any:
        while not self.words.poll(0.002):
            self.follow()
        try:
            return self.words.recv()
        except EOFError as error:
            raise TransportError("the process that asks has closed its connection; see its error") from error


@contextmanager
def _asker(service: QueryService, eyes: np.ndarray, rate_hz: float) -> Iterator[_Asker]:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=query_on_command, args=(theirs, service.endpoint, eyes, rate_hz), daemon=True)
    process.start()
    theirs.close()
    try:
        asker = _Asker(process, ours, service)
        asker.expect(READY)
        yield asker
    finally:
        ours.close()
        process.join(5.0)
        process.kill()
        process.join()


def _map_in_turns(pipeline: MappingPipeline, posed: Sequence[PosedFrame], service: QueryService, asker: _Asker) -> _Log:
    log = _Log()
    for number, chunk in enumerate(_turns(posed)):
        if number % 4 in (1, 2):
            asker.begin()
            began = time.perf_counter()
            log.asked_steps += [_mapped(pipeline, frame, service) for frame in chunk]
            log.asked += asker.rest()
            log.asked_s += time.perf_counter() - began
        else:
            log.quiet_steps += [_mapped(pipeline, frame, None) for frame in chunk]
    return log


def _turns(posed: Sequence[PosedFrame]) -> Iterator[Sequence[PosedFrame]]:
    """Pairs of turns that are equally long."""
    for start in range(0, len(posed), 2 * TURN):
        pair = posed[start : start + 2 * TURN]
        yield pair[: len(pair) // 2]
        yield pair[len(pair) // 2 :]


def _mapped(pipeline: MappingPipeline, frame: PosedFrame, service: QueryService | None) -> _Step:
    """Map a frame as the mapper node does."""
    began, worked = time.perf_counter(), time.process_time()
    pipeline.step(frame)
    stepped = time.perf_counter()
    if service is not None:
        service.follow()
    ended = time.perf_counter()
    return _Step((ended - began) * 1e3, (ended - stepped) * 1e3, (time.process_time() - worked) * 1e3)


def _mapped_while_held(
    pipeline: MappingPipeline, posed: Sequence[PosedFrame], service: _HoldingService, asker: _Asker
) -> list[float]:
    """Map frames while an answer is withheld; of each, 0 where it ended before the answer could be given, or its ms."""
    service.may_answer.clear()
    asker.words.send(ASK)
    while not service.withheld.wait(0.002):
        asker.follow()
    waits: list[float] = []
    for frame in posed:
        step = _mapped(pipeline, frame, service)
        waits.append(step.ms if service.may_answer.is_set() else 0.0)
    service.may_answer.set()
    asker.expect(ASKING)
    asker.rest()
    return waits
