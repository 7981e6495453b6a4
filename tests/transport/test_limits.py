"""Messages of too many parts, or with too much in all of them; real sockets."""

from __future__ import annotations

import threading
from contextlib import closing

import pytest
import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.codec import encode_frame
from semantic_mapper.transport.messages import MAX_KEYFRAME_BYTES, LabelledKeyframe
from semantic_mapper.transport.query_sockets import QueryServer, QuerySocket
from semantic_mapper.transport.sockets import MAX_MESSAGE_BYTES, LosslessSubscriber, NewestSubscriber, receive_bounded
from semantic_mapper.types import PosedFrame

from . import samples

WAIT_S = 20.0


@pytest.mark.parametrize("kind", [NewestSubscriber, LosslessSubscriber])
def test_a_message_of_too_many_parts_or_too_much_in_them_costs_itself_only(endpoint: str, kind) -> None:
    with zmq.Context.instance().socket(zmq.XPUB) as other, kind(endpoint, ["frame"]) as subscriber:
        other.setsockopt(zmq.LINGER, 0)
        other.bind(endpoint)
        for _ in range(2):  # subscriptions: the topic, the handshake
            assert other.poll(WAIT_S * 1e3) and other.recv()[:1] == b"\x01"
        header = [b"frame/front/", b"\x80"]
        other.send_multipart([*header, *[b"small"] * 20_000])
        whole = bytes(MAX_MESSAGE_BYTES // 3)
        other.send_multipart([*header, whole, whole, whole], copy=False)
        other.send_multipart(encode_frame(samples.make_frame(5)))
        frame = subscriber.receive(WAIT_S)
        assert isinstance(frame, PosedFrame) and frame.seq == 5
        assert subscriber.rejected == 2 and "5 parts of 33" in str(subscriber.last_error)


@pytest.mark.parametrize("kind", [NewestSubscriber, LosslessSubscriber])
def test_a_keyframe_that_is_too_large_as_a_whole_costs_itself_only(endpoint: str, kind) -> None:
    good = samples.all_messages()["keyframe"]
    with zmq.Context.instance().socket(zmq.XPUB) as stranger, kind(endpoint, ["keyframe"]) as subscriber:
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.bind(endpoint)
        for _ in range(2):  # the topic and the handshake
            assert stranger.poll(WAIT_S * 1e3)
            stranger.recv()
        half = bytes(MAX_KEYFRAME_BYTES // 2)  # neither part is too large
        stranger.send_multipart([*good[:2], half, half], copy=False)
        stranger.send_multipart([*good[:2], *[b"x"] * 1000])
        stranger.send_multipart(good)
        keyframe = subscriber.receive(WAIT_S)
        assert isinstance(keyframe, LabelledKeyframe) and keyframe.teacher == "a person"
        assert subscriber.rejected == 2 and "1002 parts of" in str(subscriber.last_error)


def test_of_a_message_beyond_the_limits_no_more_than_they_allow_is_kept() -> None:
    context = zmq.Context.instance()
    with context.socket(zmq.PAIR) as left, context.socket(zmq.PAIR) as right:
        left.connect(f"tcp://127.0.0.1:{right.bind_to_random_port('tcp://127.0.0.1')}")
        for sent, kept in (([b"abc"] * 4, 4), ([b"abc"] * 9, 4), ([b"abc", bytes(8)], 1), ([b"abc", bytes(7)], 2)):
            left.send_multipart(sent)
            parts, trouble = receive_bounded(right, max_parts=4, max_bytes=12 if len(sent) > 2 else 10)
            assert parts == sent[:kept] and bool(trouble) == (kept < len(sent))
        assert trouble == "" and not right.poll(0), "each was taken off as a whole"
        with pytest.raises(zmq.Again):
            receive_bounded(right, flags=zmq.NOBLOCK)


def test_an_answer_of_too_many_parts_is_an_error_and_the_next_one_is_not() -> None:
    with closing(QueryServer("tcp://127.0.0.1:*")) as server:
        answers = [[b"x"] * 20_000, [b"good", b""]]

        def answer() -> None:
            while answers:
                server.wait(1.0)
                if (asked := server.receive()) is not None:
                    server.send(asked[0], answers.pop(0))

        thread = threading.Thread(target=answer)
        thread.start()
        with QuerySocket(server.endpoint, timeout_s=WAIT_S, attempts=1) as client:
            with pytest.raises(TransportError, match="20000 parts of 20000 bytes"):
                client.ask([b"hello", b""])
            assert client.ask([b"hello", b""]) == [b"good", b""]
        thread.join()
