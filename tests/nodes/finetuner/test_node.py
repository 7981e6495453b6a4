"""The finetuner node in this process: keyframes in, weights out, beside a mapper or one that the test plays."""

import dataclasses
import os
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import cv2
import pytest

from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.finetuner import finetuner
from semantic_mapper.nodes.finetuner.finetuner import FinetuneRound
from semantic_mapper.nodes.finetuner.process import run as run_finetuner
from semantic_mapper.nodes.options import FinetunerOptions
from semantic_mapper.nodes.process import run_when_idle
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.online import KeyframeSplit
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import LabelledKeyframe, Status, WeightsInUse, WeightsUpdate, digest_of
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
from tests.nodes.mapper.test_live_correction import running_robot
from tests.nodes.mapper.test_query_service import a_folder
from tests.nodes.support import eventually, node_here, run_ok, write_log
from tests.small import tiny_frames
from tests.training.test_online import permuted, start_of

FRAMES = tiny_frames(8)
LEARNING = """
[finetune]
steps = 6
width = 96
held_out_rays = 64
[finetune.step]
rays = 128
"""


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights to start from, with the settings of the learning beside them."""
    folder = tmp_path_factory.mktemp("learning")
    save_checkpoint(start_of(), folder / "start.safetensors")
    (folder / "learning.toml").write_text(LEARNING, encoding="utf-8")
    return folder / "start.safetensors"


class Heard:
    """What a finetuner says, and what it receives."""

    def __init__(self, endpoints: dict[str, str], weights: LosslessSubscriber, status: NewestSubscriber) -> None:
        self.endpoints = endpoints
        self._weights, self._status = weights, status
        self.last = Status("finetuner", "starting", 0)

    def counters(self) -> dict[str, int]:
        while (message := self._status.receive(0.02)) is not None:
            self.last = message
        return dict(self.last.counters)

    def until(self, **wanted: int) -> None:
        """Waits until the counters are these."""
        assert eventually(lambda: wanted.items() <= self.counters().items()), (wanted, self.last)

    def until_warned(self, text: str) -> None:
        assert eventually(lambda: self.counters() and text in "".join(self.last.degraded[-1:])), (text, self.last)

    def update(self) -> WeightsUpdate:
        message = self._weights.receive(120)
        assert isinstance(message, WeightsUpdate)
        return message

    def teach(self, frames, teacher: str = "test") -> None:
        with Publisher(self.endpoints["labels"], policy="block") as publisher:
            publisher.wait_for_subscribers("keyframe", timeout_s=60)
            for frame in frames:
                publisher.publish(encode(LabelledKeyframe(frame, ROOMS, teacher)))


@contextmanager
def finetuning(
    start: Path, endpoints: dict[str, str], restarts: int = 0, retry_s: float = 20.0, **more: Any
) -> Iterator[Heard]:
    settings = {"config": str(start.with_name("learning.toml")), "niceness": 0, **more}
    options = FinetunerOptions(weights=str(start), cpu_fraction=1.0, **settings)
    with (
        patch.multiple(finetuner, SETTLE_S=0.3, RETRY_S=retry_s),
        LosslessSubscriber(endpoints["finetuner"], ("weights",)) as weights,
        NewestSubscriber(endpoints["finetuner"], ("status",)) as status,
        node_here(run_finetuner, "finetuner", endpoints, options, restarts=restarts),
    ):
        weights.wait_until_heard(60)
        status.wait_until_heard(60)
        yield Heard(endpoints, weights, status)


class PlayedMapper(NamedTuple):
    """What a finetuner hears of a mapper, said by the test."""

    publisher: Publisher
    endpoints: dict[str, str]

    def says(self, version: int, digest: str, *judged: int, **more: Any) -> None:
        self.publisher.publish(encode(WeightsInUse("mapper", version, digest, *judged, **more)))


@pytest.fixture
def mapper(start: Path) -> Iterator[PlayedMapper]:
    """It has the weights to start from."""
    with a_folder() as folder:
        endpoints = {name: f"ipc://{folder / name}" for name in ("mapper", "finetuner", "labels")}
        with Publisher(endpoints["mapper"]) as publisher:
            mapper = PlayedMapper(publisher, endpoints)
            mapper.says(0, digest_of(start.read_bytes()))
            yield mapper


@pytest.mark.slow
def test_keyframes_become_weights_and_the_mapper_has_the_last_word(
    start: Path, mapper: PlayedMapper, tmp_path: Path
) -> None:
    with finetuning(start, mapper.endpoints) as heard:
        wide = dataclasses.replace(FRAMES[0], label=FRAMES[0].label + 200)
        heard.teach([wide, *FRAMES[:4]])
        first = heard.update()
        assert first.version == 1 and first.parent == digest_of(start.read_bytes())
        assert first.score > first.parent_score + 0.01 and (first.keyframes, first.held_out) == (3, 1)
        (tmp_path / "first.safetensors").write_bytes(first.data)
        made = load_checkpoint(tmp_path / "first.safetensors")
        assert made.recipe["kind"] == "online" and made.recipe["parent"] == first.parent and made.recipe["version"] == 1
        heard.until(offered=1, unusable=1)
        mapper.says(1, first.digest, 1, 1, accepted=True)
        heard.until(taken=1, new=0)
        # Labels that contradict those which have proved right: rejected here, and forgotten.
        heard.teach([permuted(f) for f in FRAMES[4:]], "bad")
        heard.until(refused=1, set_aside=4, kept=4)
        assert "the last weights were refused" in heard.last.degraded[0]
        mapper.says(0, first.parent, 1, 1)  # a mapper that was started again
        heard.teach(FRAMES[4:])
        second = heard.update()
        assert (second.version, second.parent) == (2, first.parent)
        mapper.says(0, first.parent, 2, 2, accepted=False, reason="no", contradicts=True)
        heard.until(refused=2, set_aside=8, kept=4)
        mapper.says(0, "ab" * 32, 2, 2, reason="no")
        heard.until_warned("does not know")


@pytest.mark.slow
def test_a_restarted_finetuner_goes_on_where_it_was(start: Path, mapper: PlayedMapper, tmp_path: Path) -> None:
    config, out = tmp_path / "learning.toml", tmp_path / "out"
    config.write_text("least_gain = 0.0\n" + LEARNING, encoding="utf-8")
    kept = out / "weights" / "000001.safetensors"

    def runs(restarts: int):
        return finetuning(start, mapper.endpoints, restarts, out=str(out), config=str(config))

    with runs(0) as heard:
        heard.teach(FRAMES[:4])
        first = heard.update()
        kept.parent.mkdir()
        kept.write_bytes(first.data)  # as a mapper does
        mapper.says(1, first.digest, 1, 1, accepted=True)
        heard.until(taken=1)
        heard.teach(FRAMES[4:6])
        heard.until(kept=6)
    assert len(list((out / "learning").glob("*.keyframe"))) == 6
    with runs(1) as heard:
        heard.until(kept=6, new=2)
        assert not heard.last.degraded
        heard.teach(FRAMES[6:8])
        second = heard.update()
        assert (second.version, second.parent, second.keyframes, second.held_out) == (2, first.digest, 6, 2)
    # Neither weights nor keyframes are taken on trust.
    kept.write_bytes(first.data[:-1] + b"x")
    damaged = sorted((out / "learning").glob("*.keyframe"))[0]
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    with runs(2) as heard:
        heard.until(kept=7)
        heard.until_warned("does not know")
    for _ in range(2):
        with runs(0) as heard:  # another launch
            heard.until(kept=0)
        assert not list((out / "learning").glob("*.keyframe"))
    (earlier,) = out.glob("learning-earlier-*")
    assert len(list(earlier.glob("*.keyframe"))) == 7, "which people may have labelled"


def test_a_round_that_fails_or_dies_keeps_its_keyframes_for_the_next(
    start: Path, mapper: PlayedMapper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learn, under_way, go_on = finetuner.learn, threading.Event(), threading.Event()

    def dies(*arguments: Any) -> Any:
        under_way.set()
        go_on.wait(60)
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory\nmore of it")

    monkeypatch.setattr(finetuner, "learn", dies)
    with finetuning(start, mapper.endpoints, out=str(tmp_path / "out"), retry_s=60.0) as heard:
        heard.teach(FRAMES[:4])
        assert under_way.wait(60)
        heard.until(learning=1)
        shutil.copytree(tmp_path / "out", tmp_path / "killed")
        go_on.set()
        heard.until(failed=1, kept=4, set_aside=0)
        assert "RuntimeError: DefaultCPUAllocator" in heard.last.degraded[-1]
        assert "its keyframes are kept, next try in" in heard.last.degraded[-1]
    monkeypatch.setattr(finetuner, "learn", learn)
    with finetuning(start, mapper.endpoints, 1, out=str(tmp_path / "killed"), retry_s=0.5) as heard:
        update = heard.update()
        assert (update.keyframes, update.held_out) == (3, 1)
        heard.until(failed=1)
        # What hinders the mapper from taking weights says nothing about the labels, either.
        mapper.says(0, update.parent, 1, 1, reason="000001.safetensors: no space left")
        heard.until(failed=2, kept=4, refused=1)


def test_learning_has_only_what_is_left_over_of_the_processors_and_all_else_its_turn() -> None:
    with ThreadPoolExecutor(1) as worker:
        worker.submit(run_when_idle).result()
        assert worker.submit(os.sched_getscheduler, 0).result() == os.SCHED_IDLE
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_round_without_a_processor_holds_nothing_up(
    start: Path, mapper: PlayedMapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    under_way, go_on = threading.Event(), threading.Event()

    def starves(*arguments: Any) -> Any:
        under_way.set()
        go_on.wait(100)
        raise CancelledError

    monkeypatch.setattr(finetuner, "learn", starves)
    monkeypatch.setattr(finetuner, "GIVE_UP_S", 0.1)
    try:
        with finetuning(start, mapper.endpoints) as heard:
            heard.teach(FRAMES[:4])
            assert under_way.wait(60)
            mapper.says(1, "ab" * 32, 1, 1)  # the round is given up
            heard.until_warned("does not know")
            heard.teach(FRAMES[4:6])
            heard.until(kept=6, learning=1)
    finally:
        go_on.set()


def test_a_mapper_learns_while_it_maps_from_what_the_command_line_labels(start: Path, tmp_path: Path) -> None:
    log, images = write_log(tmp_path / "room.mcap", FRAMES), tmp_path / "images"
    images.mkdir()
    for number in (4, 5, 6, 7):
        cv2.imwrite(str(images / f"{number:06d}.png"), FRAMES[number].label)
    with running_robot(start, tmp_path / "out", 0, learner="finetuner") as robot:
        with finetuning(start, robot.endpoints) as heard:
            robot.send(list(FRAMES[:2]))
            said = run_ok("label", log, "--images", images, "--to", robot.endpoints["labels"]).stdout
            assert "4 labelled keyframes sent: frames 4, 5, 6, 7 of room.mcap" in " ".join(said.split())
            assert eventually(lambda: robot.status[-1].counters.get("weights_version") == 1)
            heard.until(taken=1)
            robot.send(list(FRAMES[2:6]))
        summary = robot.end(6)
    assert summary["weights"]["learned"]["taken"] == 1 and summary["weights"]["recipe"] == "online"
    assert summary["frames"]["excluded_from_scores"] == 2 and summary["frames"]["scored"] == 4
    assert summary["field"]["anchors"] == 3


def test_a_round_rests_as_its_share_says_and_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    rested_s: list[float] = []

    def steps(*arguments: Any) -> Any:
        on_progress = arguments[3]
        on_progress(FitProgress(1, 0.1, 0.0, 0.0, 0.0, best=False))
        spent_s = time.process_time()
        while time.process_time() < spent_s + 0.05:
            pass
        began_s = time.monotonic()
        on_progress(FitProgress(2, 0.2, 0.0, 0.0, 0.0, best=False))
        rested_s.append(time.monotonic() - began_s)
        while True:
            on_progress(FitProgress(3, 0.3, 0.0, 0.0, 0.0, best=False))

    monkeypatch.setattr(finetuner, "learn", steps)
    config = OnlineConfig()
    under_way = FinetuneRound(KeyframeSplit((), ()), start_of(), "ab" * 32, config, 0.25, idle=False)
    assert eventually(lambda: bool(rested_s)) and rested_s[0] >= 0.15  # three times what it worked
    assert under_way.thread.is_alive() and under_way.step >= 2
    under_way.cancelled.set()
    under_way.thread.join(60)
    assert not under_way.thread.is_alive() and under_way.result is None
