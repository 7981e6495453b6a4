"""Where the mapper of a launch answers questions; that a real one does is in tests/contract/test_sockets.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.launcher.launch_file import load_launch
from tests.nodes.support import REPLAY_LAUNCH


def test_without_a_query_endpoint_there_is_none_and_names_must_differ(tmp_path: Path) -> None:
    launch = load_launch(REPLAY_LAUNCH, ["camera.log=x"], tmp_path)
    assert launch.sockets() == ("launch", "mapper", "camera", "query")
    for query in ("", "ipc:///a/b"):
        launch = load_launch(REPLAY_LAUNCH, ["camera.log=x", f"mapper.query={query}"], tmp_path)
        assert launch.sockets() == ("launch", "mapper", "camera")
    with pytest.raises(ConfigError, match="camera: names two endpoints"):
        load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=camera"], tmp_path)
    with pytest.raises(ConfigError, match="query"):
        load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=../up"], tmp_path)
