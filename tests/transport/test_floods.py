"""Who sends without end, or breaks what receives, holds nobody up and is told of; real sockets."""

from __future__ import annotations

import errno
import time

import pytest
import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.codec import encode_frame
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
from semantic_mapper.types import PosedFrame

from . import samples
from .test_sockets import WAIT_S, eventually

FLOOD = 200


@pytest.mark.parametrize(
    ("kind", "place"), [(LosslessSubscriber, "header"), (LosslessSubscriber, "pixels"), (NewestSubscriber, "pixels")]
)
def test_a_reader_without_time_takes_no_more_of_a_flood_than_one(endpoint: str, kind, place: str) -> None:
    with zmq.Context.instance().socket(zmq.XPUB) as stranger, kind(endpoint, ["frame"]) as subscriber:
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.setsockopt(zmq.SNDHWM, 0)
        stranger.bind(endpoint)
        for _ in range(2):  # subscriptions: the topic, the handshake
            assert stranger.poll(WAIT_S * 1e3)
            stranger.recv()
        for number in range(FLOOD):
            topic, header, *buffers = encode_frame(samples.make_frame(1, camera_id=f"camera{number}"))
            if place == "header":
                header = b"\x80"
            stranger.send_multipart([topic, header, *(b"\xff" * len(buffer) for buffer in buffers)])
        if kind is NewestSubscriber:
            eventually(lambda: len(subscriber._slots) == FLOOD)
        else:
            time.sleep(0.3)  # so that many wait
        assert subscriber.receive(0.0) is None and subscriber.rejected <= 1
        stranger.send_multipart(encode_frame(samples.make_frame(5)))
        frame = subscriber.receive(WAIT_S)
        assert isinstance(frame, PosedFrame) and frame.seq == 5 and subscriber.rejected == FLOOD


def test_a_publisher_hears_a_flood_of_subscriptions_little_by_little(endpoint: str) -> None:
    with Publisher(endpoint) as publisher, zmq.Context.instance().socket(zmq.SUB) as stranger:
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.connect(endpoint)
        with publisher._mutex:  # as in a ``publish`` that has begun: nobody else hears them
            for number in range(1000):
                stranger.subscribe(f"frame/{number}/".encode())
            time.sleep(0.3)
            publisher._drain()
            assert 0 < len(publisher._counts) < 500
        eventually(lambda: publisher.subscribers("frame", "999") == 1)  # all of them in the end, in order
        assert len(publisher._counts) == 1000


def test_a_reader_whose_thread_has_failed_says_why(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> None:
        raise zmq.ZMQError(errno.EMFILE)

    with Publisher(endpoint) as publisher, NewestSubscriber(endpoint, ["frame"]) as subscriber:
        subscriber.wait_until_heard(WAIT_S)
        publisher.publish(encode_frame(samples.make_frame(5)))
        eventually(lambda: subscriber.silent_s is not None)
        monkeypatch.setattr(subscriber._connections, "mend", fails)
        assert isinstance(subscriber.receive(WAIT_S), PosedFrame), "what had come before"
        for use in (subscriber.receive, subscriber.wait_until_heard):
            with pytest.raises(TransportError, match="Too many open files"):
                use(WAIT_S)
