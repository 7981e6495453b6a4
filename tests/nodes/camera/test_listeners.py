"""The end of a stream reaches who came late, was suspended, or was too slow; real sockets."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.camera import listeners
from semantic_mapper.nodes.camera.listeners import drain
from semantic_mapper.nodes.launcher.liveness import HeartbeatWriter
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import EndOfStream, StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.nodes.mapper.test_query_service import a_folder

PATIENCE_S = 20.0
TOPICS = ("info", "frame", "end")
END = EndOfStream("camera", "end", 30)
PIXELS = np.zeros((600, 600, 3), np.uint8)
BIG = encode_frame(
    PosedFrame(
        1, 1, "camera", PIXELS, None, None, CameraIntrinsics(500, 500, 300, 300, 600, 600), np.eye(4), "test", 0
    ),
    CodecOptions(rgb="raw"),
)


@pytest.fixture
def endpoint() -> Iterator[str]:
    with a_folder() as folder:
        yield f"ipc://{folder}/camera"


@contextmanager
def draining(publisher: Publisher) -> Iterator[None]:
    """A camera that has come to its end, until all of its listeners have left."""
    stop = StopRequest()
    thread = threading.Thread(
        target=drain, args=(NodeContext("camera", {}, 1, stop, HeartbeatWriter(-1, 1)), publisher)
    )
    thread.start()
    try:
        yield
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), "it waits for somebody who has left"
    finally:
        stop.signum = 15
        thread.join(PATIENCE_S)


def until_end(subscriber: LosslessSubscriber) -> list[bytes]:
    """Topics of what comes before the end of the stream, which is awaited."""
    topics: list[bytes] = []
    while (parts := subscriber.receive_parts(PATIENCE_S)) is not None and not parts[0].startswith(b"end/"):
        topics.append(parts[0])
    assert parts is not None, "the end never came"
    return topics


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listeners, "REMIND_S", 0.1)


def test_a_live_reader_whose_queue_was_full_at_the_end_hears_of_it(endpoint: str) -> None:
    with (
        Publisher(endpoint, hwm=2) as publisher,
        LosslessSubscriber(endpoint, TOPICS, hwm=2) as suspended,
        LosslessSubscriber(endpoint, ("end",)) as awake,
    ):
        for subscriber in (suspended, awake):
            subscriber.wait_until_heard(PATIENCE_S)
        for _ in range(30):
            publisher.publish(BIG)
        publisher.publish(encode(END))
        assert awake.receive(PATIENCE_S) == END
        with draining(publisher):
            came = until_end(suspended)
            assert 0 < len(came) < 30, "else it had room, and this test says nothing"
            suspended.close()


def test_a_lossless_stream_whose_end_found_no_room_says_it_once_there_is_some(endpoint: str) -> None:
    with (
        Publisher(endpoint, policy="block", hwm=1) as publisher,
        LosslessSubscriber(endpoint, TOPICS, hwm=1) as suspended,
    ):
        suspended.wait_until_heard(PATIENCE_S)
        sent = 0
        with suppress(TransportError):
            while True:
                publisher.publish(BIG, timeout_s=0.2)
                sent += 1
        with pytest.raises(TransportError, match="has taken nothing"):
            publisher.publish(encode(END), timeout_s=0.2)
        with draining(publisher):
            assert until_end(suspended) == [BIG[0]] * sent
            suspended.close()


@pytest.mark.parametrize("kind", [LosslessSubscriber, NewestSubscriber])
def test_who_comes_when_all_is_over_does_not_keep_the_camera(endpoint: str, kind) -> None:
    info = StreamInfo("room")
    with Publisher(endpoint) as publisher, LosslessSubscriber(endpoint, ("frame",)) as keeps_it:
        keeps_it.wait_until_heard(PATIENCE_S)
        publisher.publish(encode(info, sender="camera"))
        publisher.publish(encode(END))
        with draining(publisher):
            with kind(endpoint, TOPICS) as late:
                assert [late.receive(PATIENCE_S) for _ in range(2)] == [info, END]
            keeps_it.close()
