"""Answers over real sockets are those in process, whatever else arrives; long questions delay no others."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semantic_mapper.client import MapClient
from semantic_mapper.errors import CodecError, LabelError, MapError, TransportError
from semantic_mapper.geometry import transform
from semantic_mapper.mapping.map_types import CameraPose
from semantic_mapper.mapping.moving import MovingSpace
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper import query_service
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.queries.instances import FoundThings, InstanceTracker
from semantic_mapper.queries.nearest import at
from semantic_mapper.queries.occupancy import State
from semantic_mapper.queries.questions import (
    AtRequest,
    BoxRequest,
    DistanceRequest,
    InfoRequest,
    InstancesRequest,
    NearestRequest,
    OccupancyRequest,
    RaysRequest,
    encode_request,
)
from semantic_mapper.queries.revisit import MapVisit
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.transport.keys import Keys
from semantic_mapper.transport.sockets import MAX_REQUEST_BYTES
from tests.mapping.rendered_views import small_map
from tests.mapping.test_moving import THING_M as PASSES_AT_M
from tests.mapping.test_moving import scene as passer_by
from tests.nodes.support import eventually
from tests.queries.scene import LABELS, integrate, poses, whole, whole_map
from tests.queries.test_mirror import assert_same

PLACES = np.stack(np.meshgrid(np.linspace(-0.6, 1.2, 9), np.linspace(-0.5, 0.6, 9), [0.0, 0.2, 0.41]), -1).reshape(
    -1, 3
)


@contextmanager
def a_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:  # pytest's own may be longer than a socket's path
        yield Path(folder)


@contextmanager
def answering(
    endpoint: str,
    voxel_map: VoxelMap,
    keys: Keys | None = None,
    moving: MovingSpace | None = None,
    before: MapVisit | None = None,
) -> Iterator[QueryService]:
    """A service, fed all the time as a mapper does."""
    stop = threading.Event()
    with QueryService(endpoint, voxel_map, keys=keys, moving=moving, before=before) as service:

        def feed() -> None:
            while not stop.wait(0.002):
                service.follow()

        mapper = threading.Thread(target=feed)
        mapper.start()
        try:
            yield service
        finally:
            stop.set()
            mapper.join()


@pytest.fixture
def endpoint() -> Iterator[str]:
    with a_folder() as folder:
        yield f"ipc://{folder / 'query'}"


@pytest.fixture(scope="module")
def client() -> Iterator[MapClient]:
    """Of a map that nobody changes."""
    with (
        a_folder() as folder,
        answering(f"ipc://{folder / 'query'}", whole_map()) as service,
        MapClient(service.endpoint, timeout_s=60) as client,
    ):
        yield client


def test_a_bad_or_too_long_question_is_an_error_as_in_process(client: MapClient) -> None:
    many = np.zeros((60000, 3))
    for ask, error, said in (
        (lambda: client.nearest("kettle", (0, 0, 0)), LabelError, "It has floor, table, cup, lamp"),
        (lambda: client.at([(0, 0, 0), (np.nan, 0, 0)]), MapError, "row 1 is"),
        (lambda: client.cast_rays((0, 0, 0), (0, 0, 0)), MapError, "a direction must have"),
        (lambda: client.cast_rays(PLACES[:2], PLACES[:3] + 1), MapError, "2 origins and 3 directions"),
        (lambda: client.points_in_box((0, 0, 0), (0, 1, 1)), MapError, "is empty"),
        (lambda: client.at("here"), MapError, "expected numbers"),
        (lambda: client.at((1, 2, 3)), MapError, "expected shape"),
        (lambda: client.nearest("cup", (1, 2)), CodecError, "expected"),
        (lambda: client.instances(1), CodecError, "expected"),
        (lambda: client.occupancy(np.zeros((65537, 3))), CodecError, "at most 65536 at once"),
        (lambda: client.nearest("cup", (0, 0, np.nan)), CodecError, "only finite"),
        (lambda: client.at(many, 0.5), MapError, "keep a mirror"),  # it would keep others waiting
        (lambda: client.at(many, 1e300), MapError, "keep a mirror"),
        (lambda: client.cast_rays(many, many + 1, 100), MapError, "keep a mirror"),
        (lambda: client.distance_field((-50, -50, -50), (50, 50, 50)), MapError, "keep a mirror"),
        (lambda: client.distance_field((-1e308,) * 3, (1e308,) * 3), MapError, "keep a mirror"),
    ):
        with pytest.raises(error, match=said):
            ask()


def test_answers_that_are_too_large_are_errors(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semantic_mapper.queries.questions.MAX_PART_BYTES", 1000)
    with pytest.raises(CodecError, match=r"an array of \d+ bytes, at most 1000"):
        client.points_in_box((-1, -1, -1), (1, 1, 1))
    monkeypatch.undo()
    monkeypatch.setattr(query_service, "points_in_box", Mock(side_effect=MemoryError))
    with pytest.raises(MapError, match="no memory left"):
        client.points_in_box((-1, -1, -1), (1, 1, 1))


class RawClient:
    """A raw socket that sends what it likes, and waits for an answer."""

    def __init__(self, endpoint: str) -> None:
        self.socket = zmq.Context.instance().socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(endpoint)

    def ask(self, parts: list[bytes]) -> list[bytes]:
        self.socket.send_multipart(parts)
        assert self.socket.poll(10_000), f"no answer to {parts}"
        return self.socket.recv_multipart()[1:]


@pytest.fixture(scope="module")
def raw(client: MapClient) -> Iterator[RawClient]:
    raw = RawClient(client._socket.endpoint)
    yield raw
    raw.socket.close()


@pytest.mark.parametrize(
    "parts",
    [
        [b""],
        [b"", b""],
        [b"", b"at"],
        [b"junk"],
        [b"", b"at", b"\xff" * 300_000],
        [b""] * 40,
        [b""] * 20_000,
        [b"", b"at", *[bytes(1 << 22)] * 6],
        [b"", b"info", b"\x81" * 99],
        [b"", b"info", msgpack.packb({"v": 1, "asker": "a", "waits_s": float("nan")})],
        [b"", b"info", msgpack.packb({"v": 1, "asker": "a" * 129})],
    ],
    ids=range(11),
)
def test_junk_is_answered_with_an_error(client: MapClient, raw: RawClient, parts: list[bytes]) -> None:
    kind, header = raw.ask(parts)
    assert kind == b"error" and msgpack.unpackb(header)["error"] == "CodecError"
    assert client.info().version == 14


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=12, max_size=12), st.floats(-1e308, 1e308))
def test_every_number_is_answered(client: MapClient, raw: RawClient, values: list[float], scalar: float) -> None:
    points = np.array(values).reshape(-1, 3)
    three = tuple(v if np.isfinite(v) else 0.0 for v in values[:3])
    for question in (
        encode_request("at", AtRequest(radius_m=scalar, points=points)),
        encode_request("occupancy", OccupancyRequest(points=points)),
        encode_request("cast_rays", RaysRequest(max_m=scalar, origins=points[:2], directions=points[2:])),
        encode_request("nearest", NearestRequest(class_name="cup", point=three)),
        encode_request("instances", InstancesRequest(up=three)),
        encode_request("distance_field", DistanceRequest(lower=three, upper=(scalar, 1.0, 1.0))),
    ):
        assert raw.ask([b"", *question])[0] in {b"error", question[0]}


def test_who_sends_too_much_or_takes_no_answers_stops_nobody(client: MapClient) -> None:
    flooder, lazy = RawClient(client._socket.endpoint), RawClient(client._socket.endpoint)
    flooder.socket.send_multipart([b"", b"at", b"", bytes(MAX_REQUEST_BYTES + 1)])
    lazy.socket.setsockopt(zmq.RCVHWM, 1)
    for _ in range(300):
        lazy.socket.send_multipart(
            [b"", *encode_request("points_in_box", BoxRequest(lower=(-1.0,) * 3, upper=(1.0,) * 3))]
        )
    assert client.info().version == 14
    assert not flooder.socket.poll(100), "cut off"
    flooder.socket.close()
    lazy.socket.close()


def test_a_mirror_elsewhere_is_the_growing_map(endpoint: str) -> None:
    voxel_map, corrected = small_map(LABELS), small_map(LABELS)
    with answering(endpoint, voxel_map), MapClient(endpoint, timeout_s=60) as client:
        assert client.mirror().snapshot().block_count == 0
        for seq, pose in enumerate(poses(6)):
            integrate(voxel_map, pose, seq)
            mirror = client.mirror()
            assert mirror.version <= voxel_map.version
        caught_up(client, voxel_map)
        assert client.mirror() is mirror
        assert_same(mirror.snapshot(), MapMirror.of(voxel_map).snapshot())
        for seq, pose in enumerate(poses(3)):
            shifted = pose.copy()
            shifted[:3, 3] += 0.5
            integrate(corrected, shifted, seq)
        voxel_map.take_over(corrected)
        integrate(voxel_map, poses(1)[0], 9)
        caught_up(client, voxel_map)
        assert client.mirror() is mirror and mirror.snapshot().epoch == 1
        assert_same(mirror.snapshot(), MapMirror.of(voxel_map).snapshot())


def caught_up(client: MapClient, voxel_map: VoxelMap) -> None:
    while client.mirror().version < voxel_map.version:
        threading.Event().wait(0.01)


def test_a_restarted_mapper_is_found_again_with_its_new_map(endpoint: str) -> None:
    first, second = small_map(LABELS), small_map(LABELS)
    for seq, pose in enumerate(poses(5)):
        integrate(first if seq < 2 else second, pose, seq)
    with MapClient(endpoint, timeout_s=0.5, attempts=100) as client:
        with answering(endpoint, first):
            before, info = client.mirror(), client.info()
            assert_same(before.snapshot(), MapMirror.of(first).snapshot())
        with answering(endpoint, second):
            after = client.mirror()
            assert client.info().map_id != info.map_id and after is not before and before.version == 2
            assert_same(after.snapshot(), MapMirror.of(second).snapshot())


def test_nobody_at_home(endpoint: str) -> None:
    with MapClient(endpoint, timeout_s=0.05, attempts=2) as client:
        with pytest.raises(TransportError, match=r"no answer within 2 x 0.05 s; is a mapper running"):
            client.info()
        with answering(endpoint, small_map(LABELS)), pytest.raises(TransportError, match="another process listens"):
            QueryService(endpoint, small_map(LABELS))
    with pytest.raises(TransportError, match="the client is closed"):
        client.info()


def test_where_the_last_frame_was_taken_is_told(endpoint: str) -> None:
    last, pose = list[CameraPose | None]([None]), np.diag([-1.0, -1.0, 1.0, 1.0])
    service = QueryService(endpoint, whole_map(), last_pose=lambda: last[-1])
    with service, MapClient(endpoint, timeout_s=60) as client:
        assert client.pose() is None
        last.append(CameraPose("oak", 5, None, "looking"))
        unknown = client.pose()
        assert unknown is not None and (unknown.camera_id, unknown.stamp_ns) == ("oak", 5)
        assert (unknown.T_map_camera, unknown.reason) == (None, "looking")
        last.append(CameraPose("oak", 6, pose))
        known = client.pose()
        assert known is not None and known.reason == "" and np.array_equal(known.T_map_camera, pose)


def test_what_moves_is_an_obstacle_while_it_is_there(endpoint: str) -> None:
    space = MovingSpace()
    frame, thing = passer_by(3, 60)
    with answering(endpoint, whole_map(), moving=space), MapClient(endpoint) as client:
        place = transform(frame.T_world_camera, np.array([[0.0, 0.0, PASSES_AT_M]]))
        before = client.occupancy(place)
        space.add(frame, thing)
        points = space.points
        assert before[0] != State.MOVING and (client.occupancy(points) == State.MOVING).all()
        assert (client.at(points).state == State.MOVING).all()
        field = client.distance_field(place[0] - 0.1, place[0] + 0.1)
        assert (field.state == State.MOVING).any() and not field.distance_m[field.state == State.MOVING].any()
        space.clear()
        assert (client.occupancy(points) != State.MOVING).all()


@pytest.fixture
def held(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[threading.Event, threading.Event]]:
    """`instances` hangs: set once it does, and to be set to let it go on."""
    hangs, may_go_on = threading.Event(), threading.Event()
    find = InstanceTracker.find

    def hang(self: InstanceTracker, *about: Any) -> FoundThings:
        hangs.set()
        assert may_go_on.wait(60)
        return find(self, *about)

    monkeypatch.setattr(InstanceTracker, "find", hang)
    yield hangs, may_go_on
    may_go_on.set()


def instances_along(up: tuple[float, float, float], **about: Any) -> list[bytes]:
    return [b"", *encode_request("instances", InstancesRequest(up=up, **about))]


def test_a_long_question_delays_no_short_one(client: MapClient, held: tuple[threading.Event, threading.Event]) -> None:
    hangs, may_go_on = held
    slow = RawClient(client._socket.endpoint)
    slow.socket.send_multipart(instances_along((0.0, 0.1, 1.0)))
    assert hangs.wait(60)
    for _ in range(3):
        np.testing.assert_array_equal(client.at(PLACES[:9]).label, at(whole(), PLACES[:9]).label)
    assert not slow.socket.poll(0)
    may_go_on.set()
    assert slow.socket.poll(60_000) and slow.socket.recv_multipart()[1] == b"instances"
    slow.socket.close()


def test_too_many_long_questions_are_refused(client: MapClient, held: tuple[threading.Event, threading.Event]) -> None:
    hangs, may_go_on = held
    greedy = RawClient(client._socket.endpoint)
    for _ in range(query_service.MAX_OF_CLIENT):
        greedy.socket.send_multipart(instances_along((0.3, 0.1, 1.0)))
    assert hangs.wait(60)
    kind, header = greedy.ask(instances_along((0.3, 0.1, 1.0)))
    assert kind == b"error" and "too many questions wait" in msgpack.unpackb(header)["text"]
    assert client.info().version == 14
    may_go_on.set()
    for _ in range(query_service.MAX_OF_CLIENT):
        assert greedy.socket.poll(60_000)
        assert greedy.socket.recv_multipart()[1] == b"instances"
    greedy.socket.close()


def test_a_repeated_question_keeps_its_turn_and_old_ones_go(
    endpoint: str, held: tuple[threading.Event, threading.Event]
) -> None:
    hangs, may_go_on = held
    with answering(endpoint, whole_map()) as service:
        under_way, first, again, silent = (RawClient(endpoint).socket for _ in range(4))
        under_way.send_multipart(instances_along((0.0, 0.1, 1.0), asker="u"))
        assert hangs.wait(60)
        for socket, asker, waits_s, y in ((first, "a", 60.0, 0.2), (silent, "c", 0.1, 0.4)):
            socket.send_multipart(instances_along((0.0, y, 1.0), asker=asker, waits_s=waits_s))
        assert eventually(lambda: len(service._pending) == 3, 20)
        again.send_multipart(instances_along((0.0, 0.2, 1.0), asker="a", waits_s=60.0))
        threading.Event().wait(0.2)
        may_go_on.set()
        for socket in (under_way, again):
            assert socket.poll(20_000) and socket.recv_multipart()[1] == b"instances"
        assert eventually(lambda: not service._pending and service.answered == 2, 20)
        assert not any(socket.poll(0) for socket in (first, silent))
        for socket in (under_way, first, again, silent):
            socket.close()


def test_a_bug_in_an_answer_spoils_no_later_one(client: MapClient, monkeypatch: pytest.MonkeyPatch) -> None:
    find = InstanceTracker.find

    def half_way(tracker: InstanceTracker, *about: Any) -> None:
        find(tracker, *about)
        raise KeyError("a bug")

    monkeypatch.setattr(InstanceTracker, "find", half_way)
    with pytest.raises(MapError, match="could not compute this: 'a bug'"):
        client.instances((0.5, 0.5, 1))
    monkeypatch.undo()
    assert client.instances((0.5, 0.5, 1))[0].id == 1


def test_a_bug_in_a_snapshot_does_not_reach_the_mapper(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MapMirror, "apply", Mock(side_effect=KeyError("a bug")))
    with answering(endpoint, whole_map()) as service:
        with MapClient(endpoint, timeout_s=60) as client, pytest.raises(MapError, match="busy, or ending"):
            client.info()
        assert not service.alive and "no longer answered" in service.status().warnings[0]
        service.follow()
        service.hand_over()


def test_the_map_is_copied_for_the_first_question_not_before(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_service, "MAX_BLOCKS", 50)
    voxel_map, copies = small_map(LABELS), []
    for seq, pose in enumerate(poses(14)):
        integrate(voxel_map, pose, seq)
    copy = VoxelMap.copy_changes
    monkeypatch.setattr(VoxelMap, "copy_changes", lambda self, *a: copies.append(a) or copy(self, *a))
    with QueryService(endpoint, voxel_map) as service, MapClient(endpoint, timeout_s=60) as client:
        for _ in range(50):
            service.follow()
        with pytest.raises(MapError, match="only answers questions"):  # not about the map: nothing is copied
            client.correction()
        service.hand_over()
        assert not copies
        raw = RawClient(endpoint)
        raw.socket.send_multipart([b"", *encode_request("info", InfoRequest())])
        assert eventually(lambda: service.follow() or bool(raw.socket.poll(0)), 20)
        header = msgpack.unpackb(raw.socket.recv_multipart()[2])
        assert header["map"]["version"] == voxel_map.version and len(copies) > 1
        raw.socket.close()
