"""Folders for results: one run at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.outputs import free_name, hold_folder
from tests.nodes.support import REPLAY_LAUNCH, error_line, run


def test_two_runs_do_not_write_their_results_into_one_folder(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with hold_folder(out):
        for words in (("up", REPLAY_LAUNCH, "--set", f"log={log}"), ("replay", log)):
            refused = run(*words, "--out", out)
            assert refused.returncode != 0 and "another run writes its results there" in error_line(refused.stderr)
        with hold_folder(tmp_path / "other"):
            pass
    assert not any(out.iterdir())
    with hold_folder(out), pytest.raises(ConfigError, match="--out"), hold_folder(out):
        pass


def test_a_free_name_is_one_where_nothing_is(tmp_path: Path) -> None:
    assert free_name(tmp_path / "map.npz") == tmp_path / "map.npz"
    for name in ("map.npz", "map-1.npz"):
        (tmp_path / name).touch()
    assert free_name(tmp_path / "map.npz") == tmp_path / "map-2.npz"
