"""First questions wait for the service's mirror of the map, and nothing else waits for them."""

from __future__ import annotations

import time
from collections.abc import Iterator

import msgpack
import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper import query_service
from semantic_mapper.nodes.mapper.query_service import QueryService
from tests.mapping.rendered_views import small_map
from tests.nodes.mapper.test_query_service import Stranger, a_folder, answering, good_questions
from tests.nodes.support import eventually
from tests.queries.scene import LABELS, integrate, poses, whole_map


@pytest.fixture
def endpoint() -> Iterator[str]:
    with a_folder() as folder:
        yield f"ipc://{folder / 'query'}"


def slow_map() -> VoxelMap:
    """Every block is of a version of its own, so that small deliveries need many steps."""
    voxel_map = small_map(LABELS)
    for seq, pose in enumerate(poses(6)):
        integrate(voxel_map, pose, seq)
    _, index = voxel_map._grid.sorted_blocks()
    voxel_map._grid._version[index] = np.arange(1, len(index) + 1)
    voxel_map.version = len(index)
    return voxel_map


def test_the_first_question_waits_for_all_of_a_large_map_and_others_do_not_wait_for_it(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(query_service, "MAX_BLOCKS", 50)
    monkeypatch.setattr(query_service, "ASKED_LATELY_S", 0.2)  # less than the deliveries take
    voxel_map = slow_map()
    with QueryService(endpoint, voxel_map) as service, MapClient(endpoint, timeout_s=60) as client:
        stranger = Stranger(endpoint)
        with pytest.raises(MapError, match="only answers questions"):  # it listens
            client.correction()
        assert not service.asked
        stranger.socket.send_multipart([b"", *good_questions()[0]])
        assert eventually(lambda: service.asked)
        with pytest.raises(MapError, match="only answers questions"):
            client.correct_poses({1: np.eye(4)})
        assert eventually(lambda: service.follow() or bool(stranger.socket.poll(0)), 20)
        header = msgpack.unpackb(stranger.socket.recv_multipart()[2])
        assert header["version"] == voxel_map.version > 300
        stranger.socket.close()


def test_who_waits_in_vain_for_a_mirror_is_told_so(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_service, "FIRST_CATCH_UP_S", 0.2)
    with QueryService(endpoint, whole_map()) as service, MapClient(endpoint, timeout_s=60) as client:
        for _ in range(2):
            with pytest.raises(MapError, match="busy, or ending"):
                client.info()
        assert eventually(lambda: service.answered == 2, 10) and service.abandoned == 0
        monkeypatch.setattr(query_service, "ASKED_LATELY_S", 0.0)
        stranger = Stranger(endpoint)
        for n in range(2):
            stranger.socket.send_multipart([b"", *good_questions()[n]])
            assert stranger.socket.poll(20_000)
            assert b"busy, or ending" in stranger.socket.recv_multipart()[2]
        stranger.socket.close()


def test_who_mirrors_a_map_now_and_then_gets_it_as_it_is_and_costs_nothing_in_between(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(query_service, "CATCH_UP_S", 60.0)
    monkeypatch.setattr(query_service, "ASKED_LATELY_S", 60.0)
    voxel_map = small_map(LABELS)
    places = iter(poses(4))
    integrate(voxel_map, next(places), 0)
    with answering(endpoint, voxel_map) as service, MapClient(endpoint, timeout_s=60) as client:

        def copied_without_a_question(timeout_s: float) -> bool:
            time.sleep(2 * query_service.MIRRORED_LATELY_S)
            integrate(voxel_map, next(places), voxel_map.version)
            return eventually(lambda: service._copied_version == voxel_map.version, timeout_s)

        client.mirror()
        client.mirror()  # the first one asks for classes, too, whose window is longer: let it pass
        service._wanted_until = 0.0
        assert client.mirror().version == voxel_map.version
        assert not copied_without_a_question(0.5)
        assert client.mirror().version == voxel_map.version, "it waits for a snapshot of the present map"
        client.at([(0.0, 0.0, 0.0)])
        assert copied_without_a_question(30), "who asks for an answer at once goes on to get one"
