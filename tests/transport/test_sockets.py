"""Publishers and subscribers over real sockets: delivery, restarts, floods, and messages beyond all limits."""

import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest
import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import EndOfStream, Status
from semantic_mapper.transport.sockets import (
    MAX_MESSAGE_BYTES,
    LosslessSubscriber,
    NewestSubscriber,
    Publisher,
    QueryServer,
    QuerySocket,
)
from semantic_mapper.types import PosedFrame

from . import samples

WAIT_S = 20.0


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, "did not come true"
        time.sleep(0.005)


@contextmanager
def strange_publisher(endpoint: str, kind: Any) -> Iterator[tuple[Any, Any]]:
    """A plain socket that may send anything, and who listens to it for frames."""
    with zmq.Context.instance().socket(zmq.XPUB) as other, kind(endpoint, ["frame"]) as subscriber:
        for option, value in ((zmq.LINGER, 0), (zmq.SNDHWM, 0), (zmq.XPUB_VERBOSER, 1)):
            other.setsockopt(option, value)
        other.bind(endpoint)
        yield other, subscriber


def take_subscriptions(other: Any) -> None:
    """To the topic, and to the handshake; cut connections are reported in between."""
    subscriptions = 0
    while subscriptions < 2:
        assert other.poll(WAIT_S * 1e3)
        subscriptions += other.recv()[:1] == b"\x01"


def test_publishers_and_subscribers_can_wait_for_each_other(endpoint: str) -> None:
    with NewestSubscriber(endpoint, ["frame"]) as early, pytest.raises(TransportError, match="0 of 1 publishers"):
        early.wait_until_heard(0.1)
    with Publisher(endpoint) as publisher:
        with pytest.raises(TransportError, match="0 of 1 subscribers of 'frame'"):
            publisher.wait_for_subscribers("frame", timeout_s=0.05)
        with LosslessSubscriber(endpoint, ["frame"]), NewestSubscriber(endpoint, ["frame/front"]):
            publisher.wait_for_subscribers("frame", 1, WAIT_S)
            eventually(lambda: publisher.subscribers("frame", "front") == 2)
            assert publisher.subscribers("frame", "frontal") == 1
            assert publisher.subscribers("map") == 0
        eventually(lambda: publisher.subscribers("frame", "front") == 0)


def test_nothing_is_lost_between_a_blocking_publisher_and_a_slow_lossless_subscriber(endpoint: str) -> None:
    count = 150
    with (
        Publisher(endpoint, policy="block", hwm=2) as publisher,
        LosslessSubscriber(endpoint, ["frame", "end"], hwm=2) as subscriber,
    ):
        subscriber.wait_until_heard(WAIT_S)

        def send() -> None:
            for seq in range(count):
                publisher.publish(encode_frame(samples.make_frame(seq)), WAIT_S)
            publisher.publish(encode(EndOfStream("front", "end", count)), WAIT_S)

        sender = threading.Thread(target=send)
        sender.start()
        seqs: list[int] = []
        while isinstance(message := subscriber.receive(WAIT_S), PosedFrame):
            seqs.append(message.seq)
            if len(seqs) % 40 == 0:
                time.sleep(0.1)
        sender.join()
    assert isinstance(message, EndOfStream)
    assert seqs == list(range(count))


def test_the_newest_frame_wins_and_the_end_does_not_overtake_it(endpoint: str) -> None:
    with Publisher(endpoint, policy="block") as publisher, NewestSubscriber(endpoint, ["frame", "end"]) as subscriber:
        subscriber.wait_until_heard(WAIT_S)
        for seq in range(20):
            publisher.publish(encode_frame(samples.make_frame(seq)))
            publisher.publish(encode_frame(samples.make_frame(seq, camera_id="back")))
        publisher.publish(encode(EndOfStream("player", "end", 20)))
        eventually(lambda: subscriber.overwritten == 38)
        messages = [subscriber.receive(WAIT_S) for _ in range(3)]
        assert subscriber.receive(0.01) is None
    front, back, end = messages
    assert isinstance(front, PosedFrame) and isinstance(back, PosedFrame)
    assert (front.camera_id, front.seq, back.camera_id, back.seq) == ("front", 19, "back", 19)
    assert end == EndOfStream("player", "end", 20)


def test_who_comes_late_is_told_what_the_stream_is_its_status_and_its_end_until_another_begins(endpoint: str) -> None:
    topics, end = ["info", "frame", "status", "end"], EndOfStream("player", "end", 7)
    with Publisher(endpoint) as publisher:
        publisher.publish(encode(samples.make_info(), sender="player"))
        for stamp in range(3):
            publisher.publish(encode(Status("camera", "running", stamp)))
        publisher.publish(encode(end))
        for kind in (LosslessSubscriber, NewestSubscriber):
            with kind(endpoint, topics) as subscriber:
                received = [subscriber.receive(WAIT_S) for _ in range(3)]
            assert received[-1] == end and samples.make_info() in received
            assert Status("camera", "running", 2) in received
        publisher.publish(encode(samples.make_info(), sender="player"))
        with LosslessSubscriber(endpoint, ["info", "end"]) as subscriber:
            assert subscriber.receive(WAIT_S) == samples.make_info()
            subscriber.wait_until_heard(WAIT_S)
            assert subscriber.receive(0.0) is None, "the new stream has not ended"


def test_a_publisher_that_comes_back_is_heard_again(endpoint: str) -> None:
    def publish_once_each() -> None:
        for seq in range(3):
            with Publisher(endpoint) as publisher:
                publisher.wait_for_subscribers("frame", 2, WAIT_S)
                publisher.publish(encode_frame(samples.make_frame(seq)))

    with LosslessSubscriber(endpoint, ["frame"]) as lossless, NewestSubscriber(endpoint, ["frame"]) as newest:
        thread = threading.Thread(target=publish_once_each)
        thread.start()
        for seq in range(3):
            frame = lossless.receive(WAIT_S)
            assert isinstance(frame, PosedFrame) and frame.seq == seq
        thread.join()
        eventually(lambda: lossless.connections() == 0)
        seq = -1
        while seq < 2:  # it may have read an older one in between
            frame = newest.receive(WAIT_S)
            assert isinstance(frame, PosedFrame) and frame.seq > seq
            seq = frame.seq


@pytest.mark.parametrize("kind", [NewestSubscriber, LosslessSubscriber])
def test_after_a_part_of_absurd_size_the_publisher_is_heard_again(endpoint: str, kind) -> None:
    with strange_publisher(endpoint, kind) as (other, subscriber):
        for round_number in range(2):  # and once more
            take_subscriptions(other)
            other.send_multipart(encode_frame(samples.make_frame(round_number)))
            frame = subscriber.receive(WAIT_S)
            assert isinstance(frame, PosedFrame) and frame.seq == round_number
            other.send_multipart([b"frame/front/", bytes(2**28)], copy=False)


def test_noise_from_a_subscriber_does_not_harm_the_publisher(endpoint: str) -> None:
    rng = random.Random(2)
    with Publisher(endpoint) as publisher, LosslessSubscriber(endpoint, ["frame"]) as subscriber:
        subscriber.wait_until_heard(WAIT_S)
        with zmq.Context.instance().socket(zmq.XSUB) as other:
            other.connect(endpoint)
            for _ in range(2000):
                other.send(rng.choice((b"\x00", b"\x01", b"\x02", b"")) + rng.randbytes(rng.randrange(300)))
            other.send(b"\x01" + bytes(5000))
            publisher.publish(encode_frame(samples.make_frame(1)))
            assert subscriber.receive(WAIT_S) is not None


def test_the_endpoint_of_a_killed_publisher_is_free_again(endpoint: str) -> None:
    code = (
        "import sys, time; from semantic_mapper.transport.sockets import Publisher\n"
        f"p = Publisher({endpoint!r}); print('bound', flush=True); time.sleep(600)"
    )
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "bound\n"
    with pytest.raises(TransportError):
        Publisher(endpoint)
    child.kill()
    child.wait()
    child.stdout.close()
    with Publisher(endpoint) as publisher, LosslessSubscriber(endpoint, ["end"]) as subscriber:
        subscriber.wait_until_heard(WAIT_S)
        publisher.publish(encode(EndOfStream("a", "end", 1)))
        assert subscriber.receive(WAIT_S) == EndOfStream("a", "end", 1)


def test_addresses_and_topics_that_are_none_are_refused(endpoint: str) -> None:
    for address in ("udp://127.0.0.1:1", "ipc://", "ipc://" + "a" * 200, "ipc:///no/such/folder/s", "x"):
        with pytest.raises(TransportError):
            Publisher(address)
    for topics, address in ((["frames"], endpoint), (["frame"], "nonsense"), (["frame/a b"], endpoint)):
        for kind in (LosslessSubscriber, NewestSubscriber):
            with pytest.raises(TransportError):
                kind(address, topics)


def test_closed_sockets_say_so(endpoint: str) -> None:
    publisher = Publisher(endpoint)
    lossless, newest = LosslessSubscriber(endpoint, ["end"]), NewestSubscriber(endpoint, ["end"])
    for socket in (publisher, lossless, newest):
        socket.close()
        socket.close()
    for use in (lambda: publisher.publish(samples.all_messages()["end"]), lossless.receive, newest.receive):
        with pytest.raises(TransportError, match="closed"):
            use()
    with NewestSubscriber(endpoint, ["end"]) as waiting:
        threading.Timer(0.1, waiting.close).start()
        with pytest.raises(TransportError, match="closed"):
            waiting.receive()


FLOOD = 200


@pytest.mark.parametrize("kind", [NewestSubscriber, LosslessSubscriber])
def test_a_reader_without_time_takes_no_more_of_a_flood_than_one(endpoint: str, kind) -> None:
    with strange_publisher(endpoint, kind) as (other, subscriber):
        take_subscriptions(other)
        for number in range(FLOOD):
            topic, header, *buffers = encode_frame(samples.make_frame(1, camera_id=f"camera{number}"))
            other.send_multipart([topic, header, *(b"\xff" * len(buffer) for buffer in buffers)])
        eventually(lambda: subscriber.silent_s is not None)
        assert subscriber.receive(0.0) is None and subscriber.rejected <= 1
        other.send_multipart(encode_frame(samples.make_frame(5)))
        frame = subscriber.receive(WAIT_S)
        assert isinstance(frame, PosedFrame) and frame.seq == 5 and subscriber.rejected == FLOOD


@pytest.mark.parametrize("kind", [NewestSubscriber, LosslessSubscriber])
def test_a_message_of_too_many_parts_or_too_much_in_them_costs_itself_only(endpoint: str, kind) -> None:
    with strange_publisher(endpoint, kind) as (other, subscriber):
        take_subscriptions(other)
        header = [b"frame/front/", b"\x80"]
        other.send_multipart([*header, *[b"small"] * 20_000])
        whole = bytes(MAX_MESSAGE_BYTES // 3)
        other.send_multipart([*header, whole, whole, whole], copy=False)
        other.send_multipart(encode_frame(samples.make_frame(5)))
        frame = subscriber.receive(WAIT_S)
        assert isinstance(frame, PosedFrame) and frame.seq == 5
        assert subscriber.rejected == 2


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
