"""The finetuner node in this process: keyframes in, weights out, beside a mapper or one that the test plays."""

from __future__ import annotations

import dataclasses
import os
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import msgspec
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.finetuner import finetuner
from semantic_mapper.nodes.finetuner.__main__ import run as run_finetuner
from semantic_mapper.nodes.finetuner.finetuner import FinetuneRound
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.nodes.options import FinetunerOptions, MapperOptions
from semantic_mapper.nodes.process import run_when_idle
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.online import KeyframeSplit
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import LabelledKeyframe, Status, WeightsInUse, WeightsUpdate, digest_of
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
from tests.nodes.mapper.test_live_correction import running_robot
from tests.nodes.mapper.test_query_service import a_folder
from tests.nodes.support import REPLAY_LAUNCH, eventually, node_here, run_here, write_log
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
        self.last: Status | None = None

    def counters(self) -> dict[str, int]:
        while (message := self._status.receive(0.02)) is not None:
            assert isinstance(message, Status)
            self.last = message
        return {} if self.last is None else dict(self.last.counters)

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


@contextmanager
def played_mapper(start: Path) -> Iterator[tuple[Heard, Publisher]]:
    """A finetuner whose mapper is a publisher of the test's."""
    with a_folder() as folder:
        endpoints = {name: f"ipc://{folder / name}" for name in ("mapper", "finetuner", "labels")}
        with Publisher(endpoints["mapper"]) as mapper, finetuning(start, endpoints) as heard:
            mapper.publish(encode(WeightsInUse("mapper", 0, digest_of(start.read_bytes()))))
            yield heard, mapper


@pytest.mark.slow
def test_keyframes_become_weights_and_what_the_mapper_says_of_them_counts(start: Path, tmp_path: Path) -> None:
    with played_mapper(start) as (heard, mapper):
        wide = dataclasses.replace(FRAMES[0], label=FRAMES[0].label + 200)
        heard.teach([wide, *FRAMES[:4]])
        first = heard.update()
        assert first.version == 1 and first.parent == digest_of(start.read_bytes())
        assert first.score > first.parent_score + 0.01 and (first.keyframes, first.held_out) == (3, 1)
        (tmp_path / "first.safetensors").write_bytes(first.data)
        made = load_checkpoint(tmp_path / "first.safetensors")
        assert made.recipe["kind"] == "online" and made.recipe["parent"] == first.parent and made.recipe["version"] == 1
        assert eventually(lambda: heard.counters().get("offered") == 1 and heard.counters()["unusable"] == 1)
        mapper.publish(encode(WeightsInUse("mapper", 1, first.digest, 1, 1, accepted=True)))
        assert eventually(lambda: heard.counters().get("taken") == 1 and heard.counters()["new"] == 0)
        # Labels that contradict those which have proved right: rejected here, and forgotten.
        heard.teach([permuted(f) for f in FRAMES[4:]], "bad")
        assert eventually(lambda: heard.counters().get("refused") == 1)
        assert heard.counters()["set_aside"] == 4 and heard.counters()["kept"] == 4
        assert heard.last is not None and "the last weights were refused" in heard.last.degraded[0]
        # Going back: keyframes that only those weights were made with are forgotten, too.
        mapper.publish(encode(WeightsInUse("mapper", 0, first.parent, 1, 1, accepted=True, rolled_back=1)))
        assert eventually(lambda: heard.counters().get("kept") == 0)
        heard.teach(FRAMES[:4])
        second = heard.update()
        assert (second.version, second.parent) == (2, first.parent)
        refusal = WeightsInUse("mapper", 0, first.parent, 2, 2, accepted=False, reason="no", rolled_back=1)
        mapper.publish(encode(msgspec.structs.replace(refusal, contradicts=True)))
        assert eventually(lambda: heard.counters().get("refused") == 2 and heard.counters()["kept"] == 0)
        mapper.publish(encode(WeightsInUse("mapper", 0, "ab" * 32, 2, 2, reason="no", rolled_back=1)))
        assert eventually(lambda: heard.counters() and "does not know" in heard.last.degraded[-1])  # pyright: ignore


@pytest.mark.slow
def test_a_restarted_finetuner_goes_on_with_the_weights_and_keyframes_of_the_one_before(start: Path, tmp_path: Path):
    config, out = tmp_path / "learning.toml", tmp_path / "out"
    config.write_text("least_gain = 0.0\n" + LEARNING, encoding="utf-8")
    kept = out / "weights" / "000001.safetensors"
    with a_folder() as folder:
        endpoints = {name: f"ipc://{folder / name}" for name in ("mapper", "finetuner", "labels")}

        def runs(restarts: int):
            return finetuning(start, endpoints, restarts, out=str(out), config=str(config))

        with Publisher(endpoints["mapper"]) as mapper:
            with runs(0) as heard:
                mapper.publish(encode(WeightsInUse("mapper", 0, digest_of(start.read_bytes()))))
                heard.teach(FRAMES[:4])
                first = heard.update()
                kept.parent.mkdir()
                kept.write_bytes(first.data)  # as a mapper does
                mapper.publish(encode(WeightsInUse("mapper", 1, first.digest, 1, 1, accepted=True)))
                assert eventually(lambda: heard.counters().get("taken") == 1)
                heard.teach(FRAMES[4:6])
                assert eventually(lambda: heard.counters()["kept"] == 6)
            assert len(list((out / "learning").glob("*.keyframe"))) == 6
            with runs(1) as heard:
                assert eventually(lambda: heard.counters().get("kept") == 6)
                assert heard.counters()["new"] == 2 and not heard.last.degraded  # pyright: ignore
                heard.teach(FRAMES[6:8])
                second = heard.update()
                assert (second.version, second.parent) == (2, first.digest)
                assert (second.keyframes, second.held_out) == (6, 2)
            # Neither weights nor keyframes are taken on trust.
            kept.write_bytes(first.data[:-1] + b"x")
            damaged = sorted((out / "learning").glob("*.keyframe"))[0]
            damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
            with runs(2) as heard:
                assert eventually(lambda: heard.counters().get("kept") == 7)
                assert "does not know" in heard.last.degraded[-1]  # pyright: ignore
            with runs(0) as heard:  # another launch
                assert eventually(lambda: heard.counters().get("kept") == 0)
                assert not list((out / "learning").glob("*.keyframe"))
            with runs(0) as heard:
                assert eventually(lambda: heard.counters().get("kept") == 0)
            (earlier,) = out.glob("learning-earlier-*")
            assert len(list(earlier.glob("*.keyframe"))) == 7, "which people may have labelled"


def test_a_round_that_fails_or_dies_keeps_its_keyframes_for_the_next(
    start: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learn, under_way, go_on = finetuner.learn, threading.Event(), threading.Event()

    def dies(*arguments: Any) -> Any:
        under_way.set()
        go_on.wait(60)
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory\nmore of it")

    monkeypatch.setattr(finetuner, "learn", dies)
    with a_folder() as folder:
        endpoints = {name: f"ipc://{folder / name}" for name in ("mapper", "finetuner", "labels")}
        with Publisher(endpoints["mapper"]) as mapper:
            mapper.publish(encode(WeightsInUse("mapper", 0, digest_of(start.read_bytes()))))
            with finetuning(start, endpoints, out=str(tmp_path / "out"), retry_s=60.0) as heard:
                heard.teach(FRAMES[:4])
                assert under_way.wait(60) and eventually(lambda: heard.counters()["learning"] == 1)
                shutil.copytree(tmp_path / "out", tmp_path / "killed")
                go_on.set()
                assert eventually(lambda: heard.counters().get("failed") == 1)
                assert (heard.counters()["kept"], heard.counters()["set_aside"]) == (4, 0)
                assert heard.last is not None and "RuntimeError: DefaultCPUAllocator" in heard.last.degraded[-1]
                assert "its keyframes are kept, next try in" in heard.last.degraded[-1]
            monkeypatch.setattr(finetuner, "learn", learn)
            with finetuning(start, endpoints, 1, out=str(tmp_path / "killed"), retry_s=0.5) as heard:
                update = heard.update()
                assert (update.keyframes, update.held_out) == (3, 1) and heard.counters()["failed"] == 1
                # What hinders the mapper from taking weights says nothing about the labels, either.
                refusal = WeightsInUse("mapper", 0, update.parent, 1, 1, reason="000001.safetensors: no space left")
                mapper.publish(encode(refusal))
                assert eventually(lambda: heard.counters()["failed"] == 2)
                assert (heard.counters()["kept"], heard.counters()["refused"]) == (4, 1)


def test_learning_has_only_what_is_left_over_of_the_processors_and_all_else_its_turn() -> None:
    found: list[int] = []

    def work() -> None:
        run_when_idle()
        inner = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0)))
        inner.start()
        inner.join()

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert found == [os.SCHED_IDLE] and os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_round_that_gets_no_processor_holds_up_neither_messages_nor_the_end(
    start: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    under_way, go_on = threading.Event(), threading.Event()

    def starves(*arguments: Any) -> Any:
        under_way.set()
        go_on.wait(100)
        raise CancelledError

    monkeypatch.setattr(finetuner, "learn", starves)
    monkeypatch.setattr(finetuner, "GIVE_UP_S", 0.1)
    try:
        with played_mapper(start) as (heard, mapper):
            heard.teach(FRAMES[:4])
            assert under_way.wait(60)
            mapper.publish(encode(WeightsInUse("mapper", 1, "ab" * 32, 1, 1)))  # the round is given up
            assert eventually(lambda: bool(heard.counters() and heard.last.degraded), 20)  # pyright: ignore
            assert "does not know" in heard.last.degraded[-1]  # pyright: ignore
            heard.teach(FRAMES[4:6])
            assert eventually(lambda: heard.counters()["kept"] == 6, 20) and heard.counters()["learning"] == 1
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
            code, text = run_here("label", log, "--images", images, "--to", robot.endpoints["labels"])
            assert code == 0 and "4 labelled keyframes sent: frames 4, 5, 6, 7 of room.mcap" in text, text
            assert eventually(lambda: robot.status[-1].counters.get("weights_version") == 1)
            assert eventually(lambda: heard.counters().get("taken") == 1)
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


@pytest.mark.parametrize("given", [["camera.log=kitchen.mcap", "camera.mode=realtime"], ["finetuner.niceness=18"]])
def test_the_launch_file_starts_a_finetuner_that_has_a_socket_for_labels(given: list[str], tmp_path: Path) -> None:
    path = REPLAY_LAUNCH.with_name("learning.toml")
    launch = load_launch(path, [*given, "finetuner.cpu_fraction=0.25"], tmp_path)
    options = launch.options["finetuner"]
    assert isinstance(options, FinetunerOptions) and options.cpu_fraction == 0.25 and options.inputs() == ("mapper",)
    assert options.niceness == (18 if "finetuner.niceness=18" in given else 19)
    mapper = launch.options["mapper"]
    assert isinstance(mapper, MapperOptions) and mapper.inputs() == ("camera", "finetuner")
    assert options.out == mapper.out == str(tmp_path) and options.weights == mapper.weights
    assert all(node.restart == "on-failure" for node in launch.nodes if node.kind != "camera")
    assert {"labels", "query", "finetuner"} <= set(launch.sockets()) and launch.listeners("camera") == 1
    other = path.read_text(encoding="utf-8").replace('learner = "finetuner"', 'learner = "finetunes"')
    (tmp_path / "other.toml").write_text(other, encoding="utf-8")
    with pytest.raises(ConfigError, match="did you mean `finetuner`"):
        load_launch(tmp_path / "other.toml", given, tmp_path)
