"""Folders for results: one run at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.replay.run_folder import hold_folder
from tests.nodes.support import REPLAY_LAUNCH, refused


def test_two_runs_do_not_write_their_results_into_one_folder(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with hold_folder(out):
        for words in (("up", REPLAY_LAUNCH, "--set", f"camera.log={log}"), ("replay", log)):
            assert "another run writes its results there" in refused(*words, "--out", out)
        with hold_folder(tmp_path / "other"):
            pass
    assert not any(out.iterdir())


def test_a_refused_run_leaves_no_folder_and_a_stopped_one_what_it_has_written(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no log")
    (tmp_path / "pictures").mkdir()
    for name in ("bad.mcap", "pictures"):
        assert name in refused("replay", tmp_path / name, "--out", tmp_path / "runs" / "out")
        assert not (tmp_path / "runs").exists()
    with pytest.raises(FileExistsError), hold_folder(tmp_path / "out"):  # noqa: PT012
        (tmp_path / "out" / "map.npz").touch()
        (tmp_path / "out" / "map.npz").touch(exist_ok=False)
    assert (tmp_path / "out" / "map.npz").exists()
