"""Questions that take long hold up none but each other, whatever becomes of them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError
from semantic_mapper.nodes.mapper import query_answers, query_service
from semantic_mapper.nodes.mapper.query_answers import Answers
from semantic_mapper.nodes.mapper.query_service import MAX_PENDING_OF_CLIENT
from semantic_mapper.queries.instances import Instance, InstanceTracker
from semantic_mapper.queries.lookup import at
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.occupancy import occupancy
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.transport import query_messages as messages
from semantic_mapper.transport.codec import encode_request
from tests.nodes.mapper.test_query_service import (
    PLACES,
    Stranger,
    a_folder,
    answering,
    assert_equal_fields,
    good_questions,
)
from tests.nodes.support import eventually
from tests.queries.scene import whole, whole_map


@pytest.fixture(scope="module")
def client() -> Iterator[MapClient]:
    """Of a map that nobody changes."""
    with (
        a_folder() as folder,
        answering(f"ipc://{folder / 'query'}", whole_map()) as service,
        MapClient(service.endpoint, timeout_s=60) as client,
    ):
        yield client


@pytest.fixture
def held(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[threading.Event, threading.Event]]:
    """`instances` hangs: set once it does, and to be set to let it go on."""
    hangs, may_go_on = threading.Event(), threading.Event()
    answer = Answers._instances

    def hang(self: Answers, snapshot: MapSnapshot, up: messages.Point) -> messages.Answer:
        hangs.set()
        assert may_go_on.wait(60)
        return answer(self, snapshot, up)

    monkeypatch.setattr(Answers, "_instances", hang)
    yield hangs, may_go_on
    may_go_on.set()


def long_question(up: tuple[float, float, float]) -> list[bytes]:
    return [b"", *encode_request("instances", messages.InstancesRequest(up=up))]


def two_askers(
    client: MapClient, held: tuple[threading.Event, threading.Event]
) -> tuple[Stranger, Stranger, threading.Event]:
    """The first has asked what takes long, which is under way; set the event to let it go on."""
    hangs, may_go_on = held
    first, second = Stranger(client._socket.endpoint), Stranger(client._socket.endpoint)
    first.socket.send_multipart(long_question((0.0, 0.1, 1.0)))
    assert hangs.wait(60)
    return first, second, may_go_on


def test_a_question_that_takes_long_holds_up_no_short_one(
    client: MapClient, held: tuple[threading.Event, threading.Event]
) -> None:
    first, second, may_go_on = two_askers(client, held)
    second.socket.send_multipart(long_question((0.0, 0.2, 1.0)))
    for _ in range(3):
        assert_equal_fields(client.at(PLACES[:9]), at(whole(), PLACES[:9]))
        assert client.nearest("cup", (1, 1, 1)) is not None
        assert client.cast_rays((0, 0, 2), (0, 0, -1)).distance_m > 0
        np.testing.assert_array_equal(client.occupancy(PLACES), occupancy(whole(), PLACES))
    first.socket.send_multipart([b"", *good_questions()[0]])  # of the same client: not before the long one
    assert not first.socket.poll(200) and not second.socket.poll(0)
    may_go_on.set()
    for stranger, kinds in ((first, [b"instances", b"info"]), (second, [b"instances"])):
        for kind in kinds:
            assert stranger.socket.poll(60_000)
            assert stranger.socket.recv_multipart()[1] == kind
        stranger.socket.close()


def test_who_asks_too_much_that_takes_long_is_told_so(
    client: MapClient, held: tuple[threading.Event, threading.Event]
) -> None:
    hangs, may_go_on = held
    greedy, modest = Stranger(client._socket.endpoint), Stranger(client._socket.endpoint)
    for _ in range(MAX_PENDING_OF_CLIENT):
        greedy.socket.send_multipart(long_question((0.3, 0.1, 1.0)))
    assert hangs.wait(60)
    kind, header = greedy.ask(long_question((0.3, 0.1, 1.0)))
    assert kind == b"error" and "too many questions that take long" in msgpack.unpackb(header)["text"]
    modest.socket.send_multipart(long_question((0.3, 0.2, 1.0)))
    assert client.info().version == 14
    may_go_on.set()
    assert modest.socket.poll(60_000)
    for _ in range(MAX_PENDING_OF_CLIENT):
        assert greedy.socket.poll(60_000)
        assert greedy.socket.recv_multipart()[1] == b"instances"
    for stranger in (greedy, modest):
        stranger.socket.close()


def test_all_clients_together_may_ask_only_so_much_that_takes_long(
    client: MapClient, held: tuple[threading.Event, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(query_service, "MAX_PENDING", 3)
    hangs, may_go_on = held
    first = [Stranger(client._socket.endpoint) for _ in range(3)]
    for stranger in first:
        stranger.socket.send_multipart(long_question((0.4, 0.1, 1.0)))
    assert hangs.wait(60)
    late = Stranger(client._socket.endpoint)
    for asker in ("late", "late", ""):
        kind, header = late.ask(asked_by(asker, 60.0, long_question((0.4, 0.2, 1.0))))
        assert kind == b"error" and "too many questions that take long" in msgpack.unpackb(header)["text"]
    assert late.ask([b"", *good_questions()[0]])[0] == b"info"
    may_go_on.set()
    for stranger in first:
        assert stranger.socket.poll(60_000) and stranger.socket.recv_multipart()[1] == b"instances"
    assert late.ask(long_question((0.4, 0.2, 1.0)))[0] == b"instances"
    for stranger in (*first, late):
        stranger.socket.close()


def asked_by(name: str, waits_s: float, question: list[bytes]) -> list[bytes]:
    header = msgpack.unpackb(question[2]) | {"asker": name, "waits_s": waits_s}
    return [*question[:2], msgpack.packb(header), *question[3:]]


def test_what_nobody_waits_for_any_more_is_not_computed(
    held: tuple[threading.Event, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two that give up, one asks the same again, which keeps its turn; the other says no more."""
    hangs, may_go_on = held
    monkeypatch.setattr(query_service, "GRACE_S", 0.0)
    computed: list[messages.Point] = []
    hang = Answers._instances
    monkeypatch.setattr(Answers, "_instances", lambda self, s, r: computed.append(r.up) or hang(self, s, r))
    with a_folder() as folder, answering(f"ipc://{folder / 'query'}", whole_map()) as service:
        sockets = [Stranger(service.endpoint) for _ in range(6)]
        under_way, under_way_again, first, second, again, silent = (s.socket for s in sockets)
        under_way.send_multipart(asked_by("u", 60.0, long_question((0.0, 0.1, 1.0))))
        assert hangs.wait(60)
        first.send_multipart(asked_by("a", 60.0, long_question((0.0, 0.2, 1.0))))
        assert eventually(lambda: b"a" in service._pending, 10)
        second.send_multipart(asked_by("b", 60.0, long_question((0.0, 0.3, 1.0))))
        silent.send_multipart(asked_by("c", 0.1, long_question((0.0, 0.4, 1.0))))
        assert eventually(lambda: {b"b", b"c"} <= set(service._pending), 10)
        again.send_multipart(asked_by("a", 60.0, long_question((0.0, 0.5, 1.0))))
        under_way_again.send_multipart(asked_by("u", 60.0, long_question((0.0, 0.1, 1.0))))
        assert eventually(lambda: service.abandoned == 1, 10)
        threading.Event().wait(0.2)
        may_go_on.set()
        for socket in (under_way_again, again, second):
            assert socket.poll(20_000) and socket.recv_multipart()[1] == b"instances"
        assert computed == [(0.0, 0.1, 1.0), (0.0, 0.5, 1.0), (0.0, 0.3, 1.0)]
        assert not any(socket.poll(100) for socket in (under_way, first, silent))
        assert eventually(lambda: (service.abandoned, service.answered) == (2, 3), 10)
        for stranger in sockets:
            stranger.socket.close()


def test_clients_that_time_out_are_answered_in_their_turn(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer takes longer than a client waits each time; without turns kept, none would ever come."""
    answer, computed = Answers._instances, []

    def slow(self: Answers, snapshot: MapSnapshot, request: messages.InstancesRequest) -> messages.Answer:
        computed.append(request.up)
        threading.Event().wait(0.4)
        return answer(self, snapshot, request)

    client.instances()
    monkeypatch.setattr(Answers, "_instances", slow)
    ups, found = [(0.9, 0.1 * n, 1.0) for n in range(3)], []

    def ask(up: messages.Point) -> None:
        with MapClient(client._socket.endpoint, timeout_s=0.3, attempts=50) as impatient:
            found.append(len(impatient.instances(up)))

    threads = [threading.Thread(target=ask, args=(up,)) for up in ups]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(found) == 3 and min(found) >= 2
    assert sorted(set(computed)) == ups  # a busy machine may let one of them wait past its turn, and take a second one


def test_checking_corrected_poses_holds_up_no_short_question(
    client: MapClient, held: tuple[threading.Event, threading.Event]
) -> None:
    first, second, may_go_on = two_askers(client, held)
    poses = {"stamps_ns": np.ones(1), "camera": np.zeros(1), "poses": np.eye(4)[None]}
    request = messages.CorrectPosesRequest(id="a", cameras=("",), **poses)
    second.socket.send_multipart([b"", *encode_request("correct_poses", request)])
    second.socket.send_multipart([b"", *encode_request("info", messages.InfoRequest())])
    assert client.info().version == 14
    assert not second.socket.poll(200)  # nor is its own next question answered before it
    may_go_on.set()
    for kind in (b"error", b"info"):
        assert second.socket.poll(60_000) and second.socket.recv_multipart()[1] == kind
    for stranger in (first, second):
        stranger.socket.close()


def test_a_bug_in_an_answer_ends_nothing(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*arguments: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr(InstanceTracker, "update", wrong)
    monkeypatch.setattr(query_answers, "nearest", wrong)
    for ask in (lambda: client.instances((0.5, 0.5, 1)), lambda: client.nearest("cup", (0, 0, 0))):
        with pytest.raises(MapError, match="could not compute this: 'a bug'"):
            ask()
    monkeypatch.undo()
    assert client.nearest("cup", (0, 0, 0)) is not None and len(client.instances((0.5, 0.5, 1))) >= 2


def test_an_update_of_things_that_fails_spoils_no_later_one(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> None:
    ups = [(0.7, 0.1 * n, 1.0) for n in range(6)]  # more directions than trackers are kept
    update, failed = InstanceTracker.update, []
    client.info()  # the service has compiled its kernels

    def half_way(tracker: InstanceTracker, snapshot: MapSnapshot) -> None:
        update(tracker, snapshot)
        failed.append(tracker)
        raise MemoryError

    monkeypatch.setattr(InstanceTracker, "update", half_way)
    with pytest.raises(MapError, match="no memory left"):
        client.instances(ups[0])
    asked: list[InstanceTracker] = []

    def noted(tracker: InstanceTracker, snapshot: MapSnapshot) -> tuple[Instance, ...]:
        asked.append(tracker)
        return update(tracker, snapshot)

    monkeypatch.setattr(InstanceTracker, "update", noted)
    for up in (*ups[1:], *ups):
        assert len(client.instances(up)) >= 2
    assert len(asked) == len(ups[1:]) + len(ups) and not set(failed) & set(asked)


def test_it_closes_while_questions_wait(
    held: tuple[threading.Event, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(query_service, "CLOSE_S", 0.1)
    hangs, _ = held
    with a_folder() as folder:
        endpoint = f"ipc://{folder / 'query'}"
        with answering(endpoint, whole_map()) as service:
            stranger = Stranger(endpoint)
            for _ in range(2):
                stranger.socket.send_multipart(long_question((0.0, 0.0, 1.0)))
            assert hangs.wait(60) and service.alive
        assert not service.alive
        with answering(endpoint, whole_map()), MapClient(endpoint, timeout_s=60) as late:
            assert late.info().version == 14
    stranger.socket.close()


def test_a_bug_in_a_snapshot_is_told_and_does_not_reach_the_mapper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*arguments: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr(MapMirror, "apply", wrong)
    monkeypatch.setattr(query_service, "FIRST_CATCH_UP_S", 0.5)
    with answering(f"ipc://{tmp_path / 'q'}", whole_map()) as service:
        with MapClient(service.endpoint, timeout_s=60) as client, pytest.raises(MapError, match="busy, or ending"):
            client.info()
        assert not service.alive and not service.hand_over_all(1.0)
    service.follow()
