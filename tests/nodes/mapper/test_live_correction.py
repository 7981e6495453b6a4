"""Corrected poses reach a mapper over real sockets while its stream goes on."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from semantic_mapper.client import MapClient
from semantic_mapper.config import MapperConfig, load_config
from semantic_mapper.drivers.base import CorrectedWorld
from semantic_mapper.errors import CodecError, MapError, PoseError, ShapeError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.camera.corrections import CorrectionSender
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.node import run_mapper
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.options import MapperOptions
from semantic_mapper.queries.questions import CorrectPosesRequest, encode_request
from semantic_mapper.replay.session import MapSession
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import EndOfStream, Status, StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame
from tests.mapping.test_correction import drift, drifted, true_poses
from tests.nodes.mapper.test_query_service import RawClient, a_folder
from tests.nodes.support import CONFIG, NodeHere, eventually, node_here, summary_of
from tests.small import INTRINSICS, tiny_frames

GEOMETRY = ("keys", "tsdf", "weight", "color")


@dataclasses.dataclass
class Robot:
    """A mapper node in this process, and both ends of its sockets."""

    camera: Publisher
    query: str
    out: Path
    status: list[Status]
    node: NodeHere
    endpoints: dict[str, str]

    def send(self, frames: list[PosedFrame]) -> None:
        for frame in frames:
            self.camera.publish(encode_frame(frame))

    def fused(self, count: int) -> bool:
        return eventually(lambda: bool(self.status) and self.status[-1].counters.get("fused", 0) >= count)

    def end(self, published: int) -> dict[str, Any]:
        """End the stream; the summary."""
        self.camera.publish(encode(EndOfStream("test", "end", published)))
        self.node.wait()
        return summary_of(self.out)


def config_file(folder: Path, history: int = 100) -> Path:
    path = folder / f"history{history}.toml"
    path.write_text(f"{CONFIG}[history]\nmax_frames = {history}\n", encoding="utf-8")
    return path


@contextmanager
def running_robot(
    weights: Path,
    out: Path,
    history: int = 100,
    metadata: dict[str, str] | None = None,
    context: dict[str, Any] | None = None,
    **more: Any,
) -> Iterator[Robot]:
    with a_folder() as folder:
        names = ("camera", "mapper", "query", "finetuner", "labels")
        endpoints = {name: f"ipc://{folder / name}" for name in names}
        options = MapperOptions(
            out=str(out), weights=str(weights), config=str(config_file(folder, history)), **{"delivery": "all", **more}
        )
        status: list[Status] = []
        ended = threading.Event()
        with (
            Publisher(endpoints["camera"], policy="block") as camera,
            node_here(run_mapper, "mapper", endpoints, options, **context or {}) as mapper,
        ):
            for topic in ("info", "frame", "end"):
                camera.wait_for_subscribers(topic, timeout_s=60)
            with LosslessSubscriber(endpoints["mapper"], ("status",)) as listener:

                def listen() -> None:
                    while not ended.is_set():
                        if isinstance(message := listener.receive(0.1), Status):
                            status.append(message)

                ear = threading.Thread(target=listen)
                ear.start()
                info = StreamInfo("test", {"rooms": INTRINSICS}, ROOMS, frame_hz=10.0, metadata=metadata or {})
                camera.publish(encode(info))
                try:
                    yield Robot(camera, endpoints["query"], out, status, mapper, endpoints)
                finally:
                    mapper.stop.signum = 15
                    mapper.thread.join(60)
                    ended.set()
                    ear.join()


@pytest.fixture(scope="module")
def bundle_of(weights: Path, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("bundles")

    def make(history: int = 100):
        return Mapper.load(weights, load_config(config_file(folder, history), MapperConfig))

    return make


def ideal_map(bundle_of, frames: tuple[PosedFrame, ...]) -> VoxelMap:
    pipeline = bundle_of(0).pipeline
    for frame in frames:
        pipeline.step(dataclasses.replace(frame, label=None))
    return pipeline.voxel_map


def settle(client: MapClient) -> None:
    assert eventually(lambda: not client.correction().running)


def test_a_drifting_stream_that_is_corrected_midway_ends_as_the_map_of_true_poses(weights, bundle_of, tmp_path):
    frames = tiny_frames(14)
    late = drifted(frames)
    with running_robot(weights, tmp_path / "out") as robot, MapClient(robot.query, timeout_s=60) as client:
        robot.send(late[:8])
        assert robot.fused(8)
        before = client.info()
        begun = client.correct_poses(true_poses(frames[:8], 1))
        assert (begun.used, begun.left_out, begun.frozen) == (8, 0, 0)
        robot.send(list(frames[8:]))  # from the loop closure on, poses are those of the corrected world
        settle(client)
        done = client.correction()
        assert (done.completed, done.poses, done.epoch, done.failure) == (1, 8, 1, "")
        assert robot.fused(14) and eventually(lambda: client.info().epoch == 1)
        assert before.epoch == 0 and client.info().map_id == before.map_id
        assert eventually(lambda: robot.status[-1].counters.get("corrections") == 1)
        assert robot.status[-1].counters["correction_left"] == 0 and not robot.status[-1].degraded
        summary = robot.end(14)
    saved = VoxelMap.load(tmp_path / "out" / "map.npz")
    assert saved.frames == 14 and summary["map"]["corrected_poses"] == 8
    assert summary["map"]["unfinished_correction"] is None
    ours, ideal = saved.block_state(), ideal_map(bundle_of, frames).block_state()
    for name in GEOMETRY:  # what the field rendered along the way differs a little
        assert ours[name].tobytes() == ideal[name].tobytes(), name


@pytest.mark.slow
def test_a_camera_that_closes_a_loop_moves_the_map(weights, tmp_path):
    frames = tiny_frames(8)
    unseen = {frames[-1].stamp_ns + 10: np.eye(4)}  # of an image that was never mapped
    poses = {frame.stamp_ns: frame.T_world_camera for frame in frames}
    far = {frames[-1].stamp_ns + 10**9: np.eye(4)}
    with running_robot(weights, tmp_path / "out") as robot, MapClient(robot.query, timeout_s=60) as client:
        robot.send(drifted(frames))
        assert robot.fused(8)
        with CorrectionSender(robot.query, frames[0].camera_id) as sender:
            sender.put(CorrectedWorld(poses | unseen, frames[-1].stamp_ns + 10, np.eye(4)))
            assert eventually(lambda: client.correction().completed == 1)
        assert sender.status().counters == {"corrections_sent": 1} and not any(sender.status().warnings)
        assert client.correction().poses == 8
        begun = client.correct_poses(poses | far, within_ns=1000)
        assert (begun.used, begun.left_out) == (8, 1)
        robot.end(8)


@contextmanager
def answered(pipeline: MappingPipeline) -> Iterator[tuple[LiveCorrection, MapClient]]:
    """A service whose mapper does nothing by itself."""
    correction = LiveCorrection(pipeline)
    with (
        a_folder() as folder,
        QueryService(f"ipc://{folder / 'query'}", pipeline.voxel_map, correction) as service,
        MapClient(service.endpoint, timeout_s=60) as client,
    ):
        yield correction, client


def session_of(mapper, frames: list[PosedFrame] | tuple[PosedFrame, ...]) -> MapSession:
    session = MapSession(mapper, stream_labels=ROOMS)
    for frame in frames:
        session.process(frame)
    return session


def test_what_is_refused_says_why_and_changes_nothing(bundle_of):
    frames = tiny_frames(4)
    session = session_of(bundle_of(), [*frames, dataclasses.replace(frames[3], camera_id="rear")])
    pose, stamp = frames[1].T_world_camera, frames[1].stamp_ns
    with answered(session.pipeline) as (_, client):
        for poses, options, error, says in (
            ({}, {}, MapError, "none was given"),
            ({stamp: pose * 2}, {}, PoseError, f"corrected pose of stamp {stamp}"),
            ({stamp: np.full((4, 4), np.nan)}, {}, PoseError, "NaN"),
            ({stamp: np.eye(3)}, {}, ShapeError, r"expected shape \(4, 4\)"),
            ({stamp + 2_000_000: pose}, {}, MapError, "no frame with this stamp was mapped"),
            ({("side", stamp): pose}, {}, MapError, "of camera 'side': no frame"),
            ({frames[3].stamp_ns: pose}, {}, MapError, "cameras rear, rooms have this stamp"),
            ({stamp: pose}, {"within_ns": 1000}, MapError, "cameras rear, rooms; name one"),
            ({("rooms", stamp + 2000): pose}, {"within_ns": 1000}, MapError, "none of 1 poses was taken within"),
            ({stamp: pose}, {"within_ns": 10**10}, CodecError, "within_ns"),
            ({stamp: pose}, {"until_ns": -1}, CodecError, "until_ns"),
            ({("", stamp): pose, ("rooms", stamp): pose}, {}, CodecError, "must differ"),
        ):
            with pytest.raises(error, match=says):
                client.correct_poses(poses, **options)
            assert not session.pipeline.corrector.status.running
        near = client.correct_poses({("rooms", stamp + 900): pose}, within_ns=1000)
        assert (near.used, near.running, near.total) == (1, True, 5)
    with answered(bundle_of(0).pipeline) as (_, client), pytest.raises(MapError, match=r"set history\.max_frames"):
        client.correct_poses({stamp: pose})


def test_corrected_poses_are_in_the_world_of_their_frames(bundle_of):
    frames = tiny_frames(2)
    session = session_of(bundle_of(), ())
    T_map_world = drift(0.5)
    session.odometry_sessions.known |= {0: np.eye(4), 7: T_map_world}
    for frame, world in zip(frames, (0, 7), strict=True):
        session.process(dataclasses.replace(frame, world=world))
    poses = {f.stamp_ns: drift(0.2) @ f.T_world_camera for f in frames}
    with answered(session.pipeline) as (correction, client):
        correction.advance(session, mapped=False)
        assert client.correct_poses(poses).used == 2
        while correction.running:
            correction.advance(session, mapped=False)
    placed = session.pipeline.corrector.poses()
    for frame, T in zip(frames, (np.eye(4), T_map_world), strict=True):
        np.testing.assert_allclose(placed[frame.camera_id, frame.stamp_ns], T @ poses[frame.stamp_ns], atol=1e-9)


def test_a_request_that_arrives_twice_counts_once(bundle_of):
    frames = tiny_frames(3)
    session = session_of(bundle_of(), drifted(frames))
    arrays = {
        "stamps_ns": np.array([f.stamp_ns for f in frames]),
        "camera": np.zeros(3, np.uint8),
        "poses": np.array([f.T_world_camera for f in frames]),
    }
    doubled = {name: np.concatenate((a, a)) for name, a in arrays.items()}
    with answered(session.pipeline) as (correction, client):
        raw = RawClient(client._socket.endpoint)

        def ask(name: str, **arrays: np.ndarray) -> list[bytes]:
            request = CorrectPosesRequest(id=name, cameras=("",), **arrays)
            return raw.ask([b"", *encode_request("correct_poses", request)])

        assert ask("a", **arrays)[0] == b"correct_poses"
        correction.advance(session, mapped=False)
        assert ask("a", **arrays)[0] == b"correct_poses"
        assert client.correction().done == 1  # goes on, and was not begun again
        assert b"given twice" in ask("b", **doubled)[1]
        assert b"stamps, cameras, poses of shapes" in ask("b", **arrays | {"camera": np.zeros(2, np.uint8)})[1]
        raw.socket.close()
        while correction.running:
            correction.advance(session, mapped=False)
        assert client.correction().completed == 1 and session.corrected_poses == 3


def test_it_ends_although_frames_never_stop_coming(bundle_of):
    frames = tiny_frames(14)
    session = session_of(bundle_of(), drifted(frames)[:6])
    correction = LiveCorrection(session.pipeline)
    session.pipeline.corrector.start(true_poses(frames[:6], 1))
    steps = 0
    while correction.running:
        session.process(frames[6 + steps])
        correction.advance(session, mapped=True)
        steps += 1
    assert 3 <= steps <= 7 and session.pipeline.voxel_map.frames == 6 + steps
    assert session.corrected_poses == 6


def test_what_was_not_finished_or_fails_is_told_and_the_mapper_goes_on(bundle_of, monkeypatch):
    frames = tiny_frames(4)
    session = session_of(bundle_of(), drifted(frames))
    correction = LiveCorrection(session.pipeline)
    session.pipeline.corrector.start(true_poses(frames, 1))
    monkeypatch.setattr("semantic_mapper.nodes.mapper.live_correction.STOPPED_S", 0.0)
    waits: list[int] = []
    with capture_logs() as logs:
        correction.finish(session, lambda: True, lambda: waits.append(1))
    assert len(waits) == 1 and "correction_unfinished" in [e["event"] for e in logs]
    assert session.unfinished_correction.endswith("stopped after 1 of 4 frames")
    arrays = {"stamps_ns": np.ones(1, np.int64), "camera": np.zeros(1, np.uint8), "poses": np.eye(4)[None]}
    with pytest.raises(MapError, match="the stream has ended"):
        correction.begin(CorrectPosesRequest(id="late", cameras=("",), **arrays))
    session = session_of(bundle_of(), drifted(frames))
    session.pipeline.corrector.start(true_poses(frames, 1))
    session.pipeline.corrector._end_history("the disk is full")
    correction = LiveCorrection(session.pipeline)
    correction.advance(session, mapped=False)
    assert not correction.running and "the disk is full" in correction.status().warnings[0]
    (result,) = session.process(dataclasses.replace(frames[3], stamp_ns=10**12, seq=9))
    assert isinstance(result, MapUpdate)
    correction.finish(session, lambda: False, lambda: None)
    assert "the disk is full" in session.unfinished_correction
