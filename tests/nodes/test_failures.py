"""What people name and type never ends in a traceback."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.nodes.support import run_here


def test_what_is_no_file_is_refused_by_its_name(tmp_path: Path) -> None:
    (folder := tmp_path / "dir.toml").mkdir()
    os.mkfifo(pipe := tmp_path / "pipe")
    (big := tmp_path / "big.json").write_text('{"boxes": [{"id": ' + "9" * 5000 + "}]}", encoding="utf-8")
    for words, said in (
        (("up", folder), f"{folder}: is a folder; name a launch file in it"),
        (("info", "/proc/self/mem"), "/proc/self/mem: cannot be read: Input/output error"),
        (("replay", pipe, "--out", tmp_path / "o"), f"{pipe}: cannot be read: it is no regular file"),
        (("import", pipe, tmp_path / "o.mcap"), f"{pipe}: is neither a file nor a folder"),
        (("query", "://", "info"), "://: no endpoint; endpoints read"),
        (("info", big), "value has 5000 digits"),
    ):
        code, shown = run_here(*map(str, words))
        assert code == 1 and said in " ".join(shown.split()), shown
        assert "sys.set_int" not in shown


@pytest.mark.parametrize(
    "words",
    [
        ("replay", "room\0.mcap", "--out", "x"),
        ("up", "replay\0", "--set", "camera.log=a"),
        ("query", "map\0.npz", "info"),
        ("view", "tcp://127.0.0.1:1\0"),
        ("label", "room.mcap", "--out", "x\0y"),
        ("export", "room.mcap", "--out", "x\0.rrd"),
        ("record", "a.mcap", "--topic", "fra\0me"),
        ("fleet", "table", "runs\0", "frames"),
    ],
)
def test_a_nul_in_a_name_is_wrong_usage(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, said = run_here(*words)
    assert code == 2 and ("NUL" in said or "null byte" in said), said


def test_a_nul_in_a_value_of_a_launch_is_named(log: Path) -> None:
    code, said = run_here("up", "replay", "--set", f"camera.log={log}", "--set", 'out="a\\u0000b"')
    assert code == 1 and "NUL" in said, said


def test_rates_and_numbers_that_overflow_are_refused_where_they_stand(tmp_path: Path, log: Path) -> None:
    launch = tmp_path / "a.toml"
    for option in ("rate = 1e-300", f"rate = {'9' * 5000}", f"max_frames = {'9' * 5000}"):
        launch.write_text(f'[[node]]\nname = "eye"\nkind = "camera"\n[node.options]\nlog = "{log}"\n{option}\n')
        code, said = run_here("up", launch)
        assert code == 1 and "error: " in said and "a.toml" in said, said
