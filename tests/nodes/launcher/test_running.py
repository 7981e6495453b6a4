"""Which launch is meant, and what is said at once where nobody can answer."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.launcher import running
from semantic_mapper.nodes.launcher.running import launch_folder
from tests.nodes.support import refused


def test_launches_that_could_be_meant_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for launches, says in (([], "no launch runs here"), ([tmp_path / "a", tmp_path / "b"], f"{tmp_path}/b")):
        monkeypatch.setattr(running, "running_launches", lambda found=launches: found)
        with pytest.raises(TransportError, match=says):
            launch_folder("")


def test_a_mapper_without_socket_is_not_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MapClient, "_ask_about", Mock(side_effect=AssertionError("asked all the same")))
    (tmp_path / "poses.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    mapper = f"ipc://{tmp_path}/query"
    for words in (("query", mapper, "info"), ("info", mapper), ("query", mapper, "correct", tmp_path / "poses.tum")):
        assert f"{mapper}: there is no such socket" in refused(*words)
