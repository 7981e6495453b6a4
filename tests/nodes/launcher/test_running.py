"""Which launch is meant, and what is said at once where nobody can answer."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.launcher import running
from semantic_mapper.nodes.launcher.running import launch_folder
from tests.nodes.support import run_here


def test_advice_fits_how_many_launches_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "running_launches", lambda: [])
    with pytest.raises(TransportError, match=r"no launch runs here; `semantic-mapper up LAUNCH\.toml` starts one"):
        launch_folder("")
    both = [tmp_path / "a", tmp_path / "b"]
    monkeypatch.setattr(running, "running_launches", lambda: both)
    with pytest.raises(TransportError) as caught:
        launch_folder("")
    assert all(str(folder) in str(caught.value) for folder in both) and "starts one" not in str(caught.value)
    with pytest.raises(TransportError, match="missing: no socket folder"):
        launch_folder(str(tmp_path / "missing"))


@pytest.mark.parametrize("words", [("query", "MAP", "info"), ("info", "MAP"), ("query", "MAP", "correct", "poses.tum")])
def test_a_mapper_without_a_socket_is_not_asked(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(*_: object) -> None:
        raise AssertionError("asked all the same")

    monkeypatch.setattr(MapClient, "_ask_about", ask)
    (tmp_path / "poses.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    places = {"MAP": f"ipc://{tmp_path}/query", "poses.tum": str(tmp_path / "poses.tum")}
    code, said = run_here(*(places.get(word, word) for word in words))
    assert code == 1 and f"{places['MAP']}: there is no such socket" in said
