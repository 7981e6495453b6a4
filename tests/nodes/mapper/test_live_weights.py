"""Weights are offered to a mapper over real sockets while its stream goes on: taken, refused, taken up again."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
import torch

from semantic_mapper.client import MapClient
from semantic_mapper.fields.checkpoint import Checkpoint, checkpoint_bytes, load_checkpoint, save_checkpoint
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import NYU40, ROOMS
from semantic_mapper.training.online import learn
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import WeightsInUse, WeightsUpdate, digest_of
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from tests.nodes.mapper.test_live_correction import Robot, running_robot
from tests.nodes.support import eventually, run_ok
from tests.small import SMALL_MODEL, tiny_frames
from tests.training.test_online import CONFIG, permuted, pool_of, start_of

FRAMES = tiny_frames(8)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that know the room, of which a map is sure of itself."""
    path = tmp_path_factory.mktemp("learned") / "learned.safetensors"
    save_checkpoint(learn(pool_of(FRAMES[:4]).split(), start_of(), CONFIG).checkpoint, path)
    return path


@dataclasses.dataclass
class Learner:
    """What a finetuner is to a mapper."""

    robot: Robot
    client: MapClient
    publisher: Publisher
    told: LosslessSubscriber
    last: WeightsInUse | None = None

    def offer(self, checkpoint: Checkpoint, version: int, parent: str = "", data: bytes = b"") -> WeightsInUse:
        """What the mapper says to it."""
        data = data or checkpoint_bytes(checkpoint)
        parent = parent or self.in_use().digest
        self.publisher.publish(
            encode(WeightsUpdate("finetuner", version, data, digest_of(data), parent, 0.9, 0.5, 3, 1))
        )
        assert eventually(lambda: self.in_use().judged == version, 60)
        return self.in_use()

    def in_use(self) -> WeightsInUse:
        while (message := self.told.receive(0.05)) is not None or self.last is None:
            self.last = message if isinstance(message, WeightsInUse) else self.last
        return self.last


@contextmanager
def learning_robot(weights: Path, out: Path, **more: object) -> Iterator[Learner]:
    with (
        running_robot(weights, out, 0, learner="finetuner", **more) as robot,
        Publisher(robot.endpoints["finetuner"]) as publisher,
        LosslessSubscriber(robot.endpoints["mapper"], ("in_use",)) as told,
        MapClient(robot.query, timeout_s=60) as client,
    ):
        publisher.wait_for_subscribers("weights", timeout_s=60)
        robot.send(list(FRAMES[:6]))
        assert robot.fused(6)
        yield Learner(robot, client, publisher, told)


def better(path: Path, seed: int = 0) -> Checkpoint:
    """Weights that say the same, but are other ones, with four more keyframes."""
    start = load_checkpoint(path)
    with torch.no_grad():
        start.model.state_dict()["classifier.bias"] += 1e-3 * (1 + seed)
    return Checkpoint(start.model, start.anchors, {**start.recipe, "train_stamps_ns": [f.stamp_ns for f in FRAMES[:5]]})


def misled(path: Path) -> Checkpoint:
    """Weights that call each class as the next one, and are sure of it."""
    start = load_checkpoint(path)
    state = start.model.state_dict()
    with torch.no_grad():
        for name in SRay.class_rows:
            state[name].copy_(torch.roll(state[name], 1, 0))
    return Checkpoint(start.model, tuple(permuted(a) for a in start.anchors), start.recipe)


@pytest.mark.slow
def test_better_weights_are_taken_between_two_frames(learned, tmp_path):
    with learning_robot(learned, tmp_path / "out") as learner:
        before = learner.in_use()
        assert (before.version, before.digest, before.judged) == (0, digest_of(learned.read_bytes()), 0)
        blocks = learner.client.info().blocks
        said = learner.offer(better(learned), 1)
        assert (said.version, said.accepted, said.newest, said.reason) == (1, True, 1, "")
        assert learner.client.info().blocks == blocks  # what was in the map stays
        assert learner.offer(better(learned, 1), 2).version == 2
        state = learner.client.weights()
        assert state.in_use == 2 and [v.state for v in state.versions] == ["earlier", "earlier", "in use"]
        assert learner.in_use().digest == state.versions[2].digest
        said = " ".join(run_ok("info", learner.robot.query).stdout.split())
        assert "weights 2 in use; accepted: 2, refused: 0" in said
        learner.robot.send([FRAMES[6], FRAMES[7]])
        assert learner.robot.fused(8)
        assert eventually(lambda: learner.robot.status[-1].counters.get("weights_version") == 2)
        summary = learner.robot.end(8)
    told = summary["weights"]
    assert told["learned"]["in_use"] == 2 and told["learned"]["taken"] == 2
    assert told["file"] == "000002.safetensors" and (tmp_path / "out" / "weights" / told["file"]).exists()
    # Frames 0 to 3 had been learned from, 4 and 5 were scored before they were, 6 and 7 never were.
    assert summary["frames"]["scored"] == 4 and summary["frames"]["excluded_from_scores"] == 4


@pytest.mark.slow
def test_what_is_no_good_is_refused_and_told(learned, tmp_path):
    good = better(learned)
    other_set = Checkpoint(SRay(SMALL_MODEL, NYU40).eval(), (), {"width": 96})
    wide = SRay(msgspec.structs.replace(SMALL_MODEL, feature_dim=32), ROOMS)
    encoder = copy.deepcopy(good)
    with torch.no_grad():
        next(p for n, p in encoder.model.named_parameters() if n.startswith("encoder")).add_(1e-3)
    broken = copy.deepcopy(good)
    with torch.no_grad():
        broken.model.state_dict()["classifier.bias"][0] = float("nan")
    with learning_robot(learned, tmp_path / "out") as learner:
        in_use = learner.in_use()
        pickle = b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x8c\x06system\x93."
        for version, (checkpoint, data, parent, says) in enumerate(
            (
                (good, pickle, "", "not a readable safetensors"),
                (good, checkpoint_bytes(good)[:-50], "", "not a readable safetensors"),
                (other_set, b"", "", "label set"),
                (Checkpoint(wide.eval(), (), {}), b"", "", "another network"),
                (encoder, b"", "", "image encoder is another one"),
                (broken, b"", "", "NaN"),
                (good, b"", "ab" * 32, "compared with others than those in use"),
                (misled(learned), b"", "", "min_map_agreement"),
            ),
            1,
        ):
            said = learner.offer(checkpoint, version, parent, data)
            assert (said.version, said.digest, said.accepted) == (0, in_use.digest, False), says
            assert says in said.reason and said.contradicts == (says == "min_map_agreement")
        assert eventually(lambda: learner.robot.status[-1].counters.get("weights_refused") == 8)
        assert "weights 8 were refused: where the map is sure of itself" in learner.robot.status[-1].degraded[-1]
        stale = learner.offer(good, 5)
        assert not stale.accepted and "not newer than weights 8" in stale.reason
        assert learner.offer(good, 9).version == 9  # and none of it spoils what comes after
        assert eventually(lambda: not learner.robot.status[-1].degraded)
        states = {v.version: v.state for v in learner.client.weights().versions}
        assert states == {0: "earlier", **dict.fromkeys(range(1, 9), "refused"), 9: "in use"}
        learner.robot.end(6)
    assert [p.name for p in (tmp_path / "out" / "weights").iterdir()] == ["000009.safetensors"]


@pytest.mark.slow
def test_a_restarted_mapper_goes_on_with_the_weights_that_its_forerunner_used(learned, tmp_path):
    notes = tmp_path / "notes"
    notes.mkdir()
    with learning_robot(learned, tmp_path / "out", context={"folder": notes}, min_map_agreement=0.0) as learner:
        assert learner.offer(misled(learned), 1).accepted  # the learner has the last word
        assert learner.offer(better(learned), 3).version == 3
        digest = learner.in_use().digest
        learner.robot.end(6)
    with learning_robot(learned, tmp_path / "out", context={"folder": notes, "restarts": 1}) as learner:
        assert eventually(lambda: learner.in_use().version == 3)
        assert (learner.in_use().digest, learner.in_use().newest) == (digest, 3)
        assert [v.state for v in learner.client.weights().versions] == ["earlier", "in use"]
        learner.robot.end(6)
