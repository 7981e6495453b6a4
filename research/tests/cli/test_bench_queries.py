"""``bench queries``: a map that grows is asked from another process, and nothing waits for an answer."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest

from research.cli import bench_queries
from research.cli.bench_client import KINDS
from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.transport.codec import encode_error
from tests.nodes.support import run
from tests.small import tiny_config

CONFIG = tiny_config(keyframes={"source_views": 2}, sampling={"guided": 4})


@pytest.mark.slow
def test_every_kind_of_question_is_asked_while_frames_are_mapped(tmp_path: Path, weights: Path, config: Path) -> None:
    file = tmp_path / "bench.json"
    options = ("--weights", weights, "--config", config, "--frames", "12", "--rate", "400", "--width", "96")
    done = run("bench", "queries", *options, "--out", file)
    assert done.returncode == 0, done.stderr
    assert "waiting for an answer at most 0 ms" in done.stdout and "distance_field" in done.stdout
    written = json.loads(file.read_text(encoding="utf-8"))
    assert written["machine"]["cpu"]
    found = written["queries"]
    assert set(found["asked"]) == set(found["p50_ms"]) == set(found["p95_ms"]) == set(KINDS)
    counts = found["asked"].values()
    assert max(counts) - min(counts) <= 3, "in turns; each of the three turns begins again"
    assert all(0 < found["p50_ms"][kind] <= found["p95_ms"][kind] for kind in KINDS)
    assert 0 < found["asked_hz"] <= 400
    for turn in ("quiet", "asked"):
        assert 0 < found[f"{turn}_step_p50_ms"] <= found[f"{turn}_step_p95_ms"]
    assert found["asked_cpu_p50_ms"] > 0 and found["cpu_ratio"] > 0
    assert found["step_ratio"] == pytest.approx(found["asked_step_p50_ms"] / found["quiet_step_p50_ms"], rel=0.05)
    assert 0 <= found["follow_p95_ms"] <= found["follow_longest_ms"]
    assert found["longest_wait_ms"] == 0 and found["held_steps"] == bench_queries.HELD
    assert found["size"] == "96x72" and found["frames"] == 12 and found["blocks"] > 50


@pytest.mark.slow
def test_a_mapper_that_waited_for_an_answer_would_be_found_out(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    follow, mapped, in_step = QueryService.follow, bench_queries._mapped, threading.Event()

    def patient(self: bench_queries._HoldingService) -> None:
        follow(self)
        if in_step.is_set():  # not while the benchmark waits for the question that is withheld
            self.may_answer.wait(30)

    def measured(*args: Any) -> bench_queries._Step:
        in_step.set()
        try:
            return mapped(*args)
        finally:
            in_step.clear()

    monkeypatch.setattr(bench_queries, "PATIENCE_S", 0.5)
    monkeypatch.setattr(bench_queries, "_mapped", measured)
    monkeypatch.setattr(bench_queries._HoldingService, "follow", patient)
    found = bench_queries.bench_queries(weights, CONFIG, frames=1, rate_hz=20, width=96)
    assert 100 < found["longest_wait_ms"] < 30_000


def test_turns_are_balanced_and_lose_no_frame() -> None:
    turns = list(bench_queries._turns(range(24)))  # type: ignore[arg-type]
    assert [number for turn in turns for number in turn] == list(range(24))
    assert [len(turn) for turn in turns] == [5, 5, 5, 5, 2, 2]


def test_a_client_that_fails_ends_the_measurement(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: QueryService, parts: list[bytes]) -> list[bytes]:
        return encode_error(TransportError("no"))

    monkeypatch.setattr(bench_queries._HoldingService, "_answer", refuse)
    with pytest.raises(TransportError, match="the process that asks has"):
        bench_queries.bench_queries(weights, CONFIG, frames=1, width=96)
