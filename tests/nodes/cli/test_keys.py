"""Two machines that get to know each other, and a question from one to the other's mapper."""

import json
from pathlib import Path

import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import TransportError
from semantic_mapper.transport.keys import load_keys
from tests.nodes.mapper.test_query_service import answering
from tests.nodes.support import refused, run_ok
from tests.queries.scene import whole_map


def keys(*arguments: str | Path) -> str:
    return run_ok("keys", *arguments).stdout


@pytest.mark.slow
def test_a_map_is_asked_from_another_machine(tmp_path: Path) -> None:
    robot, desk = tmp_path / "robot", tmp_path / "desk"
    public = {folder: keys("make", "--keys", folder).split()[0] for folder in (robot, desk)}
    keys("allow", "desk", public[desk], "--keys", robot)
    keys("allow", "robot", public[robot], "--keys", desk)
    shown = json.loads(keys("show", "--json", "--keys", robot))
    assert shown == {"folder": str(robot), "public": public[robot], "peers": {"desk": public[desk]}}
    assert public[robot] in keys("show", "--keys", desk)

    with answering("tcp://0.0.0.0:*", whole_map(), load_keys(robot)) as service:
        endpoint = service.endpoint.replace("0.0.0.0", "127.0.0.1")
        with MapClient(endpoint, timeout_s=60, server="robot", keys=desk) as client:
            assert client.info().blocks == whole_map().block_count
        with MapClient(endpoint, timeout_s=0.2, attempts=1) as clear, pytest.raises(TransportError, match="no answer"):
            clear.info()
        query = ("query", endpoint, "info", "--server", "robot", "--keys", desk)
        assert "table" in run_ok(*query).stdout
        keys("forget", "desk", "--keys", robot)
        assert "Does it know this machine's key" in refused(*query)


def test_no_verb_speaks_to_another_machine_without_keys(log: Path) -> None:
    for words in (
        "query tcp://192.0.2.1:5570 info",
        "view --status tcp://192.0.2.1:5570 --once",
        "info tcp://192.0.2.1:5570",
        f"label {log} --keyframes 2 --to tcp://0.0.0.0:5570",
    ):
        said = refused(*words.split())
        assert "semantic-mapper keys make" in said and "ssh -L" in said, words
