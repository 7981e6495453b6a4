"""Folders for results: one run at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.replay.run_folder import hold_folder
from tests.nodes.support import REPLAY_LAUNCH, error_line, run, run_here


def test_two_runs_do_not_write_their_results_into_one_folder(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with hold_folder(out):
        for words in (("up", REPLAY_LAUNCH, "--set", f"camera.log={log}"), ("replay", log)):
            refused = run(*words, "--out", out)
            assert refused.returncode != 0 and "another run writes its results there" in error_line(refused.stderr)
        with hold_folder(tmp_path / "other"):
            pass
    assert not any(out.iterdir())
    with hold_folder(out), pytest.raises(ConfigError, match="--out"), hold_folder(out):
        pass


def test_a_refused_run_leaves_no_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no log")
    (tmp_path / "pictures").mkdir()
    for words in (("replay", tmp_path / "bad.mcap"), ("replay", tmp_path / "pictures")):
        code, said = run_here(*words, "--out", tmp_path / "runs" / "out")
        assert code == 1
        assert words[1].name in said
        assert not (tmp_path / "runs").exists()


def test_a_stopped_run_keeps_what_it_has_written(tmp_path: Path) -> None:
    with pytest.raises(FileExistsError), hold_folder(tmp_path / "out"):  # noqa: PT012
        (tmp_path / "out" / "map.npz").touch()
        (tmp_path / "out" / "map.npz").touch(exist_ok=False)
    assert (tmp_path / "out" / "map.npz").exists()
