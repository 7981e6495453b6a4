"""Several camera nodes into one log, and what a node makes of several streams; real sockets and files."""

import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from semantic_mapper.errors import NodeError, TransportError
from semantic_mapper.labels import NYU40
from semantic_mapper.nodes.mapper.node import run_mapper
from semantic_mapper.nodes.options import MapperOptions, RecorderOptions
from semantic_mapper.nodes.publishing import PublicPublisher
from semantic_mapper.nodes.recorder.node import run_recorder
from semantic_mapper.nodes.streams import Streams
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.keys import ServerIdentity, allow, make_keys
from semantic_mapper.transport.messages import EndOfStream, Status, StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from tests.nodes.mapper.test_query_service import a_folder
from tests.nodes.support import free_port, node_here, summary_of
from tests.small import INTRINSICS, tiny_frames

LEFT, RIGHT = StreamInfo("left eye", {"left": INTRINSICS}), StreamInfo("right eye", {"right": INTRINSICS})


def test_two_cameras_are_recorded_until_both_have_ended_and_one_may_start_anew(tmp_path: Path) -> None:
    frame = tiny_frames(1)[0]
    with a_folder() as folder:
        endpoints = {name: f"ipc://{folder}/{name}" for name in ("left", "right", "recorder")}
        options = RecorderOptions(out=str(tmp_path / "both.mcap"), sources=("left", "right"), streams=2)
        with (
            Publisher(endpoints["right"]) as right,
            node_here(run_recorder, "recorder", endpoints, options) as recorder,
        ):
            for restart in range(2):  # the camera's process dies after three frames and counts from 0 again
                with Publisher(endpoints["left"]) as left:
                    left.wait_for_subscribers("frame", timeout_s=20)
                    left.publish(encode(LEFT, sender="left"))
                    for seq in range(3):
                        stamp_ns = (10 * restart + seq + 1) * 1000
                        left.publish(encode_frame(replace(frame, camera_id="left", seq=seq, stamp_ns=stamp_ns)))
                    if restart:
                        left.publish(encode(EndOfStream("left", "end", 3)))
            right.wait_for_subscribers("frame", timeout_s=20)
            right.publish(encode(RIGHT, sender="right"))
            for seq in range(2):
                right.publish(encode_frame(replace(frame, camera_id="right", seq=seq, stamp_ns=20_000 + seq)))
            right.publish(encode(EndOfStream("right", "end", 2)))
            recorder.wait(20)
    with LogReader(tmp_path / "both.mcap") as log:
        frames = list(log)
        assert log.finished and not log.errors
        assert dict(log.info.cameras) == {"left": INTRINSICS, "right": INTRINSICS}
        assert json.loads(log.attachments()["calibration.json"].data)["cameras"].keys() == {"left", "right"}
        assert log.info.source == "left eye + right eye"
    assert [f.seq for f in frames if f.camera_id == "left"] == [0, 1, 2, 0, 1, 2]
    assert [f.seq for f in frames if f.camera_id == "right"] == [0, 1]


def test_two_cameras_of_different_size_are_fused_into_one_map(tmp_path: Path, weights: Path, config: Path) -> None:
    small = replace(INTRINSICS, cx=INTRINSICS.cx - 8, cy=INTRINSICS.cy - 6, width=80, height=60)
    infos = {"left": LEFT, "right": StreamInfo("right eye", {"right": small})}
    with a_folder() as folder, ExitStack() as stack:
        endpoints = {name: f"ipc://{folder}/{name}" for name in ("left", "right", "mapper")}
        files = {"out": str(tmp_path), "weights": str(weights), "config": str(config)}
        options = MapperOptions(**files, input=("left", "right"), delivery="all", query="")
        publishers = {name: stack.enter_context(Publisher(endpoints[name], policy="block")) for name in infos}
        node = stack.enter_context(node_here(run_mapper, "mapper", endpoints, options))
        for name, publisher in publishers.items():
            publisher.wait_for_subscribers("frame", timeout_s=120)
            publisher.publish(encode(infos[name], sender=name))
        for frame in tiny_frames(4):
            publishers["left"].publish(encode_frame(replace(frame, camera_id="left", label=None)), 120)
            images = {"rgb": frame.rgb[6:66, 8:88].copy(), "depth_m": frame.depth_m[6:66, 8:88].copy()}
            cut = replace(frame, camera_id="right", **images, label=None, intrinsics=small)
            publishers["right"].publish(encode_frame(cut), 120)
        publishers["left"].publish(encode(EndOfStream("left", "end", 4)))
        node.thread.join(0.5)
        assert node.thread.is_alive()  # the other one has not ended
        publishers["right"].publish(encode(EndOfStream("right", "end", 5)))  # one was lost on the way
        node.wait(200)
    summary = summary_of(tmp_path)
    assert sorted(summary["source"].split(" + ")) == ["left eye", "right eye"]  # whichever came first
    assert summary["stopped_by"] is None
    frames = summary["frames"]
    assert (frames["published"], frames["fused"], frames["dropped"], frames["refused"]) == (9, 8, 1, 0)


def test_streams_end_together_and_those_of_other_classes_are_refused() -> None:
    streams = Streams(2)
    assert not streams.begin(LEFT) and not streams.begin(RIGHT)
    assert not streams.end(EndOfStream("a", "end", 3))
    assert not streams.end(EndOfStream("a", "error", 4, "unplugged"))  # restarted meanwhile
    assert streams.end(EndOfStream("b", "end", 5))
    assert (streams.published, streams.ended_by) == (9, "a: unplugged")
    with pytest.raises(NodeError, match="'another' have other classes than those of 'left eye'"):
        streams.begin(StreamInfo("another", {"third": INTRINSICS}, NYU40))


def test_a_fixed_endpoint_serves_peers_alone_where_there_are_keys(tmp_path: Path) -> None:
    robot, desk = make_keys(tmp_path / "robot"), make_keys(tmp_path / "desk")
    allow(tmp_path / "robot", "desk", desk.public.decode())
    allow(tmp_path / "desk", "robot", robot.public.decode())
    status = Status("mapper", "running", 5)
    with a_folder() as folder:
        own = f"ipc://{folder}/mapper"
        with pytest.raises(TransportError, match="needs keys on both sides"):
            PublicPublisher(own, "tcp://0.0.0.0:*", "")
        port = free_port()
        far = f"tcp://127.0.0.1:{port}"
        with (
            PublicPublisher(own, f"tcp://0.0.0.0:{port}", str(tmp_path / "robot")) as publisher,
            LosslessSubscriber(own, ("status",)) as near,
            LosslessSubscriber(far, ("status",), identity=ServerIdentity(desk, "robot")) as peer,
            LosslessSubscriber(far, ("status",)) as stranger,
        ):
            near.wait_until_heard(20)
            peer.wait_until_heard(20)
            publisher.publish(encode(status))
            assert near.receive(20) == peer.receive(20) == status
            assert stranger.receive(0.2) is None
        PublicPublisher(own, "", "").close()  # free again
