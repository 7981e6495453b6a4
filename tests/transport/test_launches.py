"""Which running launch is meant, and that its mapper is found, and found again."""

import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import TransportError
from semantic_mapper.transport.keys import load_keys, make_keys
from semantic_mapper.transport.launches import NOTE, STATUS_SOCKET, find_mapper, is_running_mapper, launch_folder
from semantic_mapper.transport.process_folder import OwnFolder
from tests.mapping.rendered_views import small_map
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.queries.scene import LABELS


@pytest.fixture(autouse=True)
def no_launch_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with a_folder() as folder:
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        yield


def start(stack: ExitStack, name: str, **options: object) -> Path:
    """What a launcher leaves in its folder; its one mapper does not answer yet."""
    folder = OwnFolder()
    stack.callback(folder.close)
    (folder.path / STATUS_SOCKET).touch()
    node = {"name": "mapper", "kind": "mapper", "options": options, "restart": "never", "enabled": True}
    (folder.path / NOTE).write_text(json.dumps({"launch": f"{name}.toml", "nodes": [node] if options else []}))
    return folder.path


def test_a_client_finds_the_launch_that_runs_and_the_next_one() -> None:
    with pytest.raises(TransportError, match="no launch runs here; `semantic-mapper demo --live"):
        MapClient()
    with ExitStack() as first:
        folder = start(first, "replay", query="query")
        first.enter_context(answering(f"ipc://{folder}/query", small_map(LABELS)))
        client = MapClient(timeout_s=60)
        before = client.info().map_id
        for place in ("live", "replay", "replay.toml", str(folder), f"ipc://{folder}/query"):
            assert is_running_mapper(place)
            assert find_mapper(place).endpoint == f"ipc://{folder}/query"
    with pytest.raises(TransportError, match="no launch runs here"):
        client.info()
    with ExitStack() as second:
        folder = start(second, "replay", query="questions")
        second.enter_context(answering(f"ipc://{folder}/questions", small_map(LABELS)))
        assert client.info().map_id != before
        client.close()
        with pytest.raises(TransportError, match="the client is closed"):
            client.info()


def test_launches_that_could_be_meant_are_named(tmp_path: Path) -> None:
    with ExitStack() as stack:
        one, other = start(stack, "replay", query="a"), start(stack, "camera")
        for place, says in (("live", f"replay.toml \\({one}\\)"), ("robot", f"camera.toml \\({other}\\)")):
            with pytest.raises(TransportError, match=says):
                launch_folder(place)
        with pytest.raises(TransportError, match="none of its nodes answers"):
            find_mapper("camera")
        again = start(stack, "replay", query="a")
        with pytest.raises(TransportError, match=str(again)):
            find_mapper("replay")
        assert not is_running_mapper("robot") and not is_running_mapper(str(tmp_path))


def test_a_mapper_for_other_machines_is_reached_from_this_one_with_the_same_keys(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    (keys.folder / "peers" / "desk.key").write_bytes((keys.folder / "own.key").read_bytes())
    with ExitStack() as stack:
        service = stack.enter_context(answering("tcp://0.0.0.0:*", small_map(LABELS), load_keys(keys.folder)))
        start(stack, "onboard", query=service.endpoint, keys=str(keys.folder))
        with MapClient(timeout_s=60) as client:
            assert client.info().version == 0
