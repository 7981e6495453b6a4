"""Learning while mapping, measured: mIoU against time, what it costs a step, a swap, two refusals, a roll-back.

A mapper and a finetuner run as processes. This one plays the camera, over and over and as fast as the mapper maps, the
teacher, and the wire between the two, so that it can also offer weights of its own. Frames that are labelled for
learning are never scored. While the finetuner learns, the same 24 frames are mapped over and over, and it is frozen
(SIGSTOP) or thawed every few frames: each frame is mapped with it and without it, one lap apart, in one run.

Example: python -m research.experiments.online_learning kitchen.mcap --picture runs/learning.png
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from research.experiments.paired_steps import LAP, Turn, slowdown
from semantic_mapper.client import MapClient
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.fields.checkpoint import Checkpoint, checkpoint_bytes, default_checkpoint_path, load_checkpoint
from semantic_mapper.files import write_json
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.launcher.processes import NodeProcess
from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.plots import Curve, Panel, draw_panels, write_picture
from semantic_mapper.replay.evaluate.truth import TruthMapper
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.training.select import candidate_from_frame, choose_keyframes
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import (
    EndOfStream,
    LabelledKeyframe,
    Status,
    StreamInfo,
    WeightsInUse,
    WeightsUpdate,
    digest_of,
)
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame

WINDOW = 12  # scored frames that a point of the curve stands for
PATIENCE_S = 900.0  # for a round of learning
FRAME_NS = 166_666_667
MARKS = {  # events in the picture
    "weights exchanged": "swap",
    "rejected by the finetuner": "rejected",
    "refused by the mapper": "refused",
    "rolled back": "roll-back",
}


@dataclass(slots=True)
class Step:
    """One frame as it was mapped: when, how long, in which turn (None: nothing was learned), and how well."""

    at_s: float
    step_ms: float
    turn: Turn | None
    version: int
    matrix: ConfusionMatrix | None


@dataclass(slots=True)
class Story:
    """What happened."""

    steps: list[Step] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)

    def miou(self, versions: Sequence[int], chosen: Callable[[Step], bool] = lambda step: True) -> float | None:
        """Over the scored frames that were mapped with these weights, laps apart, which are few frames many times."""
        total: ConfusionMatrix | None = None
        for step in self.steps:
            if step.version in versions and step.matrix is not None and step.turn is None and chosen(step):
                total = step.matrix if total is None else total + step.matrix
        return None if total is None else total.metrics().miou

    def curve(self) -> list[tuple[float, float]]:
        """mIoU of each ``WINDOW`` scored frames, at the time of the last."""
        scored = [s for s in self.steps if s.matrix is not None]
        points: list[tuple[float, float]] = []
        for end in range(WINDOW, len(scored) + 1, WINDOW // 2):
            window = scored[end - WINDOW : end]
            total = ConfusionMatrix(window[0].matrix.label_set)  # pyright: ignore[reportOptionalMemberAccess]
            for step in window:
                total = total + step.matrix  # pyright: ignore[reportOperatorIssue]
            points.append((window[-1].at_s, 100 * (total.metrics().miou or 0.0)))
        return points

    def slowdown(self) -> dict[str, Any]:
        """What learning costs a step; see ``paired_steps``."""
        return slowdown([(s.turn, s.step_ms) for s in self.steps if s.turn is not None])


class Robot:
    """The two processes, and this one's ends of their sockets."""

    def __init__(self, stack: ExitStack, args: argparse.Namespace, out: Path, frames: list[PosedFrame]) -> None:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sm-")))
        names = ("camera", "mapper", "query", "finetuner", "labels", "offers")
        self._endpoints = {name: f"ipc://{folder}/{name}" for name in names}
        self._out, self._args = out, args
        self._frames = frames
        self._played = self._laps = 0
        self._position = 0  # in the log, over and over
        self._began = time.monotonic()
        self.story = Story()
        self.version, self.in_use = 0, WeightsInUse("mapper", 0, "")
        self.status: Status | None = None
        self._turn: Turn | None = None
        self._frozen = self._measuring = False
        self._passed_on = 0  # version
        self._camera = stack.enter_context(Publisher(self._endpoints["camera"], policy="block"))
        self._offers = stack.enter_context(Publisher(self._endpoints["offers"]))
        self._labels = stack.enter_context(Publisher(self._endpoints["labels"], policy="block"))
        learning = {
            "cpu_fraction": args.fraction,
            "niceness": args.niceness,
            "weights": args.weights,
            "config": args.learning,
        }
        self.finetuner = self._start(stack, "finetuner", learning)
        self._mapper = self._start(
            stack,
            "mapper",
            {"out": str(out), "learner": "offers", "delivery": "all", "config": args.config, "weights": args.weights},
        )
        self._answers = stack.enter_context(LosslessSubscriber(self._endpoints["mapper"], ("map", "refused")))
        self._told = stack.enter_context(LosslessSubscriber(self._endpoints["mapper"], ("in_use",)))
        self._made = stack.enter_context(LosslessSubscriber(self._endpoints["finetuner"], ("weights",)))
        self._news = stack.enter_context(NewestSubscriber(self._endpoints["finetuner"], ("status",)))
        self.client = stack.enter_context(MapClient(self._endpoints["query"], timeout_s=30))
        self._camera.wait_for_subscribers("frame", timeout_s=300)
        self._answers.wait_until_heard(300)
        self._labels.wait_for_subscribers("keyframe", timeout_s=300)

    def _start(self, stack: ExitStack, kind: str, options: dict[str, Any]) -> NodeProcess:
        child = NodeProcess(kind, NodeJob(name=kind, options=options, endpoints=self._endpoints))
        stack.callback(child.close)
        return child

    def begin(self, info: StreamInfo) -> None:
        """Tell the mapper what is to come."""
        self._camera.publish(encode(info))

    def note(self, what: str, **more: Any) -> None:
        """Keep an event, and tell of it."""
        event = {"at_s": round(time.monotonic() - self._began, 1), "frame": self._played, "what": what, **more}
        self.story.events.append(event)
        print(json.dumps(event), flush=True)

    def map_frames(self, count: int, score: Callable[[int, MapUpdate], ConfusionMatrix | None]) -> None:
        """Map the next frames of the log, from its beginning after its end."""
        for _ in range(count):
            self._toggle()
            position = self._position + (self._turn.place if self._turn is not None else 0)
            number = position % len(self._frames)
            stamp_ns = self._played * FRAME_NS
            frame = dataclasses.replace(self._frames[number], label=None, seq=self._played, stamp_ns=stamp_ns)
            self._camera.publish(encode_frame(frame))
            answer = self._answers.receive(300)
            if not isinstance(answer, MapUpdate):
                raise SystemExit(f"the mapper said {answer}")
            step = Step(
                at_s=time.monotonic() - self._began,
                step_ms=sum(answer.stage_ms.values()),
                turn=self._turn,
                version=self.version,
                matrix=score(number, answer),
            )
            self.story.steps.append(step)
            self._played += 1
            self._position += self._turn is None
            self._hear()

    def map_until(self, done: Callable[[], bool], score: Callable[[int, MapUpdate], ConfusionMatrix | None]) -> None:
        """Map frames until something has happened; while the finetuner learns, in laps."""
        began = time.monotonic()
        self._measuring = True
        while not done():
            if time.monotonic() - began > PATIENCE_S:
                raise SystemExit(f"nothing has come of it in {PATIENCE_S:g} s; {self.status}")
            self.map_frames(1, score)
        self._measuring = False
        self._leave_laps()

    @property
    def working(self) -> bool:
        """Whether the finetuner was in the middle of a round when it last spoke."""
        return self.status is not None and self.status.counters.get("learning", 0) > 0

    def counter(self, name: str) -> int:
        """Of the finetuner."""
        return 0 if self.status is None else int(self.status.counters.get(name, 0))

    def teach(self, frames: Sequence[PosedFrame], label_set: LabelSet, teacher: str) -> None:
        """Send labelled keyframes."""
        for frame in frames:
            self._labels.publish(encode(LabelledKeyframe(frame, label_set, teacher)))
        self.note("keyframes sent", count=len(frames), teacher=teacher)

    def offer(self, checkpoint: Checkpoint) -> None:
        """Offer weights to the mapper, as a finetuner would that has found them better."""
        data, version = checkpoint_bytes(checkpoint), self.in_use.newest + 1
        update = WeightsUpdate("script", version, data, digest_of(data), self.in_use.digest, 1.0, 0.0, 1, 1)
        self._offers.publish(encode(update))
        self.note("weights offered by a teacher that is wrong throughout", version=version)

    def end(self) -> dict[str, Any]:
        """End both; the mapper's summary."""
        self.finetuner.ask_to_stop()
        self._camera.publish(encode(EndOfStream("script", "end", self._played)))
        for child in (self.finetuner, self._mapper):
            if not child.wait(120) or child.exit_code():
                raise SystemExit(child.describe_end())
        return json.loads((self._out / "summary.json").read_text(encoding="utf-8"))

    def _hear(self) -> None:
        while (update := self._made.receive(0.0)) is not None:
            assert isinstance(update, WeightsUpdate)
            if update.version <= self._passed_on:  # told once more, after a time of silence
                continue
            self._passed_on = update.version
            self.note("weights offered", version=update.version, score=update.score, parent_score=update.parent_score)
            self._offers.publish(encode(update))
        while (message := self._told.receive(0.0)) is not None:
            assert isinstance(message, WeightsInUse)
            if message.version != self.version:
                back = message.rolled_back > self.in_use.rolled_back
                self.note("rolled back" if back else "weights exchanged", version=message.version)
            elif message.judged > self.in_use.judged and not message.accepted:
                self.note("refused by the mapper", version=message.judged, reason=message.reason)
            self.version, self.in_use = message.version, message
        while (status := self._news.receive(0.0)) is not None:
            assert isinstance(status, Status)
            if self.counter("refused") < status.counters["refused"]:
                self.note("rejected by the finetuner", reason=" ".join(status.degraded))
            self.status = status

    def _toggle(self) -> None:
        if not (self._measuring and self.working):
            self._leave_laps()
            return
        self._laps += self._turn is None
        self._turn = Turn(self._laps, 0, 0) if self._turn is None else self._turn.after()
        if self._turn.frozen != self._frozen:
            self._frozen = self._turn.frozen
            os.kill(self.finetuner.pid, signal.SIGSTOP if self._frozen else signal.SIGCONT)

    def _leave_laps(self) -> None:
        if self._turn is not None:
            self._turn, self._position = None, self._position + LAP
        if self._frozen:
            self._frozen = False
            os.kill(self.finetuner.pid, signal.SIGCONT)


def permuted(frame: PosedFrame, label_set: LabelSet) -> PosedFrame:
    """Labels shuffled: each class is called as another one, always the same one."""
    assert frame.label is not None
    ids = np.array(label_set.ids, np.uint8)
    table = np.arange(256, dtype=np.uint8)
    table[ids] = np.roll(ids, -1)
    return dataclasses.replace(frame, label=table[frame.label])


def misled(path: Path) -> Checkpoint:
    """Weights as they would be after learning from shuffled labels alone: sure of the wrong classes."""
    start = load_checkpoint(path)
    with torch.no_grad():
        for name in type(start.model).class_rows:
            rows = start.model.state_dict()[name]
            rows.copy_(torch.roll(rows, 1, 0))
    anchors = tuple(permuted(a, start.label_set) for a in start.anchors)
    return Checkpoint(start.model, anchors, start.recipe)


def run(args: argparse.Namespace, out: Path) -> dict[str, Any]:
    """All of it."""
    weights = Path(args.weights) if args.weights else default_checkpoint_path()
    label_set = load_checkpoint(weights).label_set
    with LogReader(args.log) as log:
        frames, info = [log.frame(i) for i in range(len(log))], log.info
    assert info.label_set is not None
    truth = TruthMapper(info.label_set, label_set)
    chosen = choose_keyframes([candidate_from_frame(f) for f in frames], args.keyframes + args.bad, 0)
    bad = chosen[1 :: max(1, len(chosen) // args.bad)][: args.bad]
    good = [i for i in chosen if i not in bad]

    def score(number: int, update: MapUpdate) -> ConfusionMatrix | None:
        label = frames[number].label
        if number in chosen or label is None:
            return None
        return confusion_of(truth.to_map_ids(label, f"frame {number}"), update.label, label_set)

    with ExitStack() as stack:
        robot = Robot(stack, args, out, frames)
        robot.begin(msgspec.structs.replace(info, frame_count=None))
        robot.map_frames(args.frames, score)
        robot.teach([frames[i] for i in good], info.label_set, "good")
        robot.map_until(lambda: robot.version == 1, score)
        robot.map_frames(args.frames, score)
        shuffled = [permuted(frames[i], info.label_set) for i in bad]
        robot.teach(shuffled, info.label_set, "shuffled")
        robot.map_until(lambda: robot.counter("refused") > 0, score)
        version = robot.version
        robot.offer(misled(out / "weights" / f"{version:06d}.safetensors"))
        robot.map_until(lambda: robot.in_use.judged > version and not robot.in_use.accepted, score)
        robot.map_frames(2 * args.frames, score)
        robot.client.return_to_weights(0)
        robot.map_until(lambda: robot.version == 0, score)
        robot.map_frames(3 * args.frames, score)
        summary = robot.end()
        story = robot.story
    swap = next(e["frame"] for e in story.events if e["what"] == "weights exchanged")
    back = next(e["frame"] for e in story.events if e["what"] == "rolled back")
    order = {id(step): number for number, step in enumerate(story.steps)}
    return {
        "log": Path(args.log).name,
        "frames": len(story.steps),
        "labelled": {"good": good, "shuffled": bad},
        "scored_classes": list(truth.shared),
        "share_of_a_core": args.fraction,
        "miou": {
            "before": story.miou((0,), lambda s: order[id(s)] < swap),
            "after_the_swap": story.miou((1,)),
            "after_the_roll_back": story.miou((0,), lambda s: order[id(s)] >= back),
        },
        "slowdown": story.slowdown(),
        "events": story.events,
        "weights": summary["weights"],
        "curve": story.curve(),
    }


def draw(found: dict[str, Any], path: Path) -> None:
    """mIoU against time, with what happened."""
    events = {e["what"]: e["at_s"] for e in reversed(found["events"])}
    marks = [Curve(name, ((events[e], 0.0), (events[e], 100.0))) for e, name in MARKS.items() if e in events]
    curve = Curve("mIoU", tuple((x, y) for x, y in found["curve"]), marked=True)
    panel = Panel(f"mIoU of {WINDOW} frames", "mIoU, %", "seconds of mapping", [curve, *marks])
    write_picture(path, draw_panels("", [panel], 1, (1080, 420)))


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="log with labels (.mcap)")
    parser.add_argument("--weights", default="", help="to start from; without it those of the package")
    parser.add_argument("--config", default="", help="TOML file with settings of the mapper")
    parser.add_argument("--learning", default="", help="TOML file with an OnlineConfig")
    parser.add_argument("--keyframes", type=int, default=12, help="labelled well")
    parser.add_argument("--bad", type=int, default=8, help="labelled with shuffled classes, later")
    parser.add_argument("--frames", type=int, default=60, help="mapped before learning; a multiple of it later")
    parser.add_argument("--share", type=float, default=0.5, help="of a core, for the finetuner")
    parser.add_argument("--niceness", type=int, default=19, help="of the finetuner, 0 to 19")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--picture", type=Path, help="draw mIoU against time (.png)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as out:
        found = run(args, Path(out))
    if args.json:
        write_json(args.json, found)
    if args.picture:
        draw(found, args.picture)
    print(json.dumps({k: found[k] for k in ("miou", "slowdown")}, indent=1))


if __name__ == "__main__":
    main()
