"""What unknown clients send: a flood of garbage to a mapper, to its questions and to a pose topic; a wrong key."""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from research.experiments.fault_table import Outcome
from research.experiments.fuzz_targets import TARGETS, flip
from research.experiments.long_log import INTRINSICS, distinct_frames
from semantic_mapper.client import MapClient
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.poses.config import TopicPoses
from semantic_mapper.drivers.poses.topic import TopicPoseSource
from semantic_mapper.errors import CodecError, SemanticMapperError, TransportError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.launcher.launcher import process_stats
from semantic_mapper.nodes.launcher.processes import NodeProcess
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.queries.questions import decode_question
from semantic_mapper.transport.codec import decode, encode, encode_frame, unpack_parts
from semantic_mapper.transport.keys import allow, make_keys
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.transport.pose_message import PoseMessage, decode_pose, encode_pose
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import MapUpdate

POOL = 4000  # different bad messages of each kind; they are sent again and again
ANSWER_S = 60.0
SHARES = {"frame": 0.6, "question": 0.2, "pose": 0.2}  # of all garbage


def bad_messages(target: str, seed: int, count: int = POOL) -> list[list[bytes]]:
    """Structured mutations of real messages, and noise, all of which have to be refused."""
    rng = random.Random(seed)
    seeds = TARGETS[target].seeds()
    accepts = {"message": decode, "question": decode_question, "pose": decode_pose}[target]
    found: list[list[bytes]] = []
    while len(found) < count:
        if rng.random() < 0.2:
            parts = [rng.randbytes(rng.randrange(1, 60)) for _ in range(rng.randint(1, 6))]
        else:
            spoiled = TARGETS[target].mutate(rng.choice(seeds), rng, lambda part: flip(part, rng))
            try:
                parts = unpack_parts(spoiled)
            except CodecError:
                parts = [spoiled]
        if target == "message" and parts:  # what our own publisher would not send, or nobody subscribes to
            parts = [rng.choice((b"frame/front/", b"info/x/", b"end/x/")), *(parts[1:] or [b""])]
        try:
            accepts(parts)
        except CodecError:
            if parts and sum(map(len, parts)) < 2000:
                found.append(parts)
    return found


class FloodedMapper:
    """A mapper node with a query service whose camera is we ourselves.

    Args:
        weights, config: As of its options.
        folder: For sockets and results.
    """

    def __init__(self, weights: str, config: str, folder: Path) -> None:
        self.endpoints = {name: f"ipc://{folder}/{name}" for name in ("camera", "mapper", "query")}
        options = {"out": str(folder / "out"), "delivery": "newest", "weights": weights, "config": config}
        self.publisher = Publisher(self.endpoints["camera"], policy="block")
        self.child = NodeProcess("mapper", NodeJob(name="mapper", options=options, endpoints=self.endpoints))
        self.publisher.wait_for_subscribers("frame", 1, ANSWER_S * 3)
        self.answers = LosslessSubscriber(self.endpoints["mapper"], ("map", "refused", "status"))
        self.answers.wait_until_heard(ANSWER_S * 3)
        self._frames = distinct_frames()
        self._sent = 0
        self.publisher.publish(encode(StreamInfo("flood", {"rooms": INTRINSICS}, ROOMS), sender="camera"))

    def map_one(self) -> float:
        """Seconds until a good frame is in the map."""
        frame = self._frames[self._sent % len(self._frames)]
        self._sent += 1
        parts = encode_frame(replace(frame, seq=self._sent, stamp_ns=time.monotonic_ns()))
        began_s = time.monotonic()
        self.publisher.publish(parts, ANSWER_S)
        while time.monotonic() - began_s < ANSWER_S:
            answer = self.answers.receive(0.1)
            if isinstance(answer, MapUpdate) and answer.seq == self._sent:
                return time.monotonic() - began_s
        raise SystemExit("the mapper did not map a good frame after a flood")

    def close(self) -> None:
        """End the node."""
        self.answers.close()
        self.child.request_stop()
        self.child.wait(ANSWER_S)
        self.child.close()
        self.publisher.close()


def floods(weights: str, config: str, rounds: int, messages: int) -> Iterator[Outcome]:
    """``messages`` bad ones in all: after each portion, the next good one has to be answered, and rightly."""
    portion = {kind: round(fraction * messages / rounds) for kind, fraction in SHARES.items()}
    bad = {
        kind: bad_messages("message" if kind == "frame" else kind, seed)
        for seed, kind in enumerate(("frame", "question", "pose"))
    }
    with tempfile.TemporaryDirectory(prefix="flood-") as folder, ExitStack() as stack:
        mapper = FloodedMapper(weights, config, Path(folder))
        stack.callback(mapper.close)
        for _ in range(20):  # compiled, allocated, warm
            mapper.map_one()
        client = stack.enter_context(MapClient(mapper.endpoints["query"], timeout_s=ANSWER_S))
        map_id = client.info().map_id
        pid = mapper.child.pid
        pose_flood = _PoseFlood(f"ipc://{folder}/poses", stack)
        before = process_stats(pid)
        for count in range(rounds):
            for n in range(portion["frame"]):
                mapper.publisher.publish(_two(bad["frame"][n % POOL]), ANSWER_S)
            yield _outcome("frames", mapper.map_one(), portion["frame"], pid, mapper)
            _flood_questions(mapper.endpoints["query"], bad["question"], portion["question"])
            began_s = time.monotonic()
            info = client.info()
            wrong = int(info.map_id != map_id or info.blocks <= 0)
            yield _outcome("questions", time.monotonic() - began_s, portion["question"], pid, mapper, wrong)
            yield pose_flood.round(bad["pose"], portion["pose"])
            print(f"floods: round {count + 1} of {rounds}", flush=True)
        after = process_stats(pid)
        print(f"mapper before and after all floods: {before} {after}", flush=True)


def _two(parts: Sequence[bytes]) -> Sequence[bytes]:
    return parts if len(parts) > 1 else [*parts, b""]


def _outcome(where: str, back_s: float, sent: int, pid: int, mapper: FloodedMapper, wrong: int = 0) -> Outcome:
    died = int(mapper.child.exit_code() is not None or mapper.child.pid != pid)
    return Outcome(f"garbage flood, {where}", back_s, others=died + wrong, counts={"bad messages": sent})


def _flood_questions(endpoint: str, bad: Sequence[Sequence[bytes]], count: int) -> None:
    """As fast as they are taken; the answers (errors) are read and thrown away."""
    socket = zmq.Context.instance().socket(zmq.DEALER)
    socket.setsockopt(zmq.LINGER, int(1000 * ANSWER_S))
    socket.connect(endpoint)
    for n in range(count):
        socket.send_multipart([b"", *bad[n % len(bad)]])
        while socket.poll(0):
            socket.recv_multipart()
    socket.close()


class _PoseFlood:
    """A pose topic with garbage on it, and what interpolates its poses."""

    def __init__(self, endpoint: str, stack: ExitStack) -> None:
        self._socket = zmq.Context.instance().socket(zmq.XPUB)
        self._socket.setsockopt(zmq.XPUB_NODROP, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(endpoint)
        stack.callback(self._socket.close)
        self._source = stack.enter_context(TopicPoseSource(TopicPoses(endpoint=endpoint), ANSWER_S))
        if not self._socket.poll(10_000):
            raise SystemExit("the pose source did not subscribe")

    def round(self, bad: Sequence[Sequence[bytes]], count: int) -> Outcome:
        """Garbage, then one good pose: an image of that moment has to get it."""
        refused = sum(self._source.counters.values())
        for n in range(count):
            self._socket.send_multipart(list(bad[n % len(bad)]))
        began_s, stamp_ns = time.monotonic(), time.monotonic_ns()
        x = float(stamp_ns % 1000)
        message = PoseMessage(stamp_ns=stamp_ns, position=(x, 0.0, 0.0), quaternion=(0.0, 0.0, 0.0, 1.0))
        self._socket.send_multipart(encode_pose(message))
        rgb = np.zeros((INTRINSICS.height, INTRINSICS.width, 3), np.uint8)
        found = self._source.pose(CameraImage(stamp_ns, 0, "front", rgb, None, INTRINSICS))
        back_s = time.monotonic() - began_s
        wrong = int(found is None or found.T_world_camera[0, 3] != x)
        counted = sum(self._source.counters.values()) - refused - 1
        counts = {"bad messages": count, "refused and counted": counted}
        return Outcome("garbage flood, poses", back_s, lost_frames=wrong, others=int(counted != count), counts=counts)


def wrong_keys(rounds: int) -> Iterator[Outcome]:
    """Who is not on the allow-list, or speaks in the clear, gets nothing; who is, is answered at once afterwards."""
    with tempfile.TemporaryDirectory(prefix="keys-") as name, ExitStack() as stack:
        folder = Path(name)
        robot, desk, stranger = (make_keys(folder / who) for who in ("robot", "desk", "stranger"))
        allow(robot.folder, "desk", desk.public.decode())
        for keys in (desk, stranger):
            allow(keys.folder, "robot", robot.public.decode())
        voxel_map = VoxelMap(VoxelMapConfig(), ROOMS)
        service = stack.enter_context(QueryService("tcp://127.0.0.1:*", voxel_map, keys=robot))
        with MapClient(service.endpoint, server="robot", keys=desk.folder, timeout_s=ANSWER_S) as client:
            map_id = client.info().map_id  # compiled
        files = len(os.listdir("/proc/self/fd"))
        for _ in range(rounds):
            let_in = sum(
                _is_answered(service.endpoint, **who) for who in ({"server": "robot", "keys": stranger.folder}, {})
            )
            began_s = time.monotonic()
            with MapClient(service.endpoint, server="robot", keys=desk.folder, timeout_s=ANSWER_S) as client:
                right = client.info().map_id == map_id
            back_s = time.monotonic() - began_s
            left = _files_left(files)
            yield Outcome(
                "wrong key, and none",
                back_s,
                others=let_in + int(not right),
                counts={"strangers": 2, "files left open": left},
            )


def _files_left(before: int, within_s: float = 2.0) -> int:
    """Open files beyond those before, once ZeroMQ has closed the connections that clients have left."""
    deadline = time.monotonic() + within_s
    while (left := len(os.listdir("/proc/self/fd")) - before) > 0 and time.monotonic() < deadline:
        time.sleep(0.05)
    return max(0, left)


def _is_answered(endpoint: str, **who: Any) -> bool:
    try:
        with MapClient(endpoint, timeout_s=0.5, **who) as client:
            client.info()
    except (TransportError, SemanticMapperError):
        return False
    return True
