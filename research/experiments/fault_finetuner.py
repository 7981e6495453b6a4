"""Faults of a finetuner beside a mapper: killed or frozen, learning or not."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from research.experiments.fault_table import Outcome
from research.experiments.live_launch import LiveLaunch, is_alive
from research.experiments.long_log import INTRINSICS
from research.scenes import TRAIN_SEEDS, room_frames
from semantic_mapper.labels import ROOMS
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import LabelledKeyframe, Status
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

NODES = ("camera", "mapper", "finetuner")  # of learning.toml
KEYFRAMES = 8
FAULTS = {"kill -9": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP}
SETTLE_S = 1.5  # between two faults
PATIENCE_S = 120.0  # for a word of the finetuner


def finetuner_faults(settings: Sequence[str], out: Path, rounds: int) -> Iterator[Outcome]:
    """kill -9 and SIGSTOP of the finetuner, which has keyframes to learn from; a launch each round."""
    for count in range(rounds):
        yield from _finetuner_faults(settings, out / f"launch-{count}")
        print(f"finetuner: round {count + 1} of {rounds}", flush=True)


def _finetuner_faults(settings: Sequence[str], out: Path) -> Iterator[Outcome]:
    with LiveLaunch(settings, out, name="learning.toml", nodes=NODES) as launch:
        folder = launch.sockets()
        camera, mapper = launch.listen()
        with (
            LosslessSubscriber(f"ipc://{folder}/finetuner", ("status",)) as words,
            Publisher(f"ipc://{folder}/labels", policy="block") as labels,
        ):
            labels.wait_for_subscribers("keyframe", timeout_s=PATIENCE_S)
            for frame in room_frames(TRAIN_SEEDS[7], KEYFRAMES, INTRINSICS):
                labels.publish(encode(LabelledKeyframe(frame, ROOMS, "script")))
            while _next_word(words).counters["kept"] < KEYFRAMES:
                pass
            for fault in FAULTS:
                time.sleep(SETTLE_S)
                yield _hit(launch, words, fault)
        assert camera.came and mapper.came, "frames were mapped meanwhile"
    if left := sum(map(is_alive, launch.all_pids())):
        raise SystemExit(f"{left} processes were left behind")


def _hit(launch: LiveLaunch, words: LosslessSubscriber, fault: str) -> Outcome:
    assert launch.mapper is not None
    pids, told = launch.pids(), launch.told
    while words.receive(0.0) is not None:
        pass
    began_s = time.monotonic()
    learning = _is_learning(launch, began_s)
    os.kill(pids["finetuner"], FAULTS[fault])
    told.wait(r"node_ended .*node=finetuner ", began_s)
    told.wait(r"node_started .*node=finetuner ", began_s)
    told.wait(r"\[finetuner\].* taken_up ", began_s)
    word = _next_word(words)
    back_s = time.monotonic()
    now = launch.pids()
    numbers = [seq for at, seq in launch.mapper.numbers("map") if began_s - 1.0 <= at < back_s]
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    kept = word.counters["kept"]
    counts = {"keyframes lost": KEYFRAMES - kept, "rounds of learning cut off": int(learning)}
    others = sum(now[n] != pids[n] for n in NODES if n != "finetuner")
    return Outcome(f"{fault} finetuner", back_s - began_s, missing, others=others, counts=counts)


def _is_learning(launch: LiveLaunch, now_s: float) -> bool:
    began = launch.told.last(r"\[finetuner\].* round_begins ", now_s)
    ended = launch.told.last(r"\[finetuner\].* (?:round_ends|round_failed|round_given_up|taken_up) ", now_s)
    return began is not None and (ended is None or ended[0] < began[0])


def _next_word(words: LosslessSubscriber) -> Status:
    word = words.receive(PATIENCE_S)
    if not isinstance(word, Status):
        raise SystemExit(f"the finetuner says nothing for {PATIENCE_S:g} s")
    return word
