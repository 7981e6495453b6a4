"""What people name and type never ends in a traceback."""

from __future__ import annotations

import os
from pathlib import Path

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


def test_rates_and_numbers_that_overflow_are_refused_where_they_stand(tmp_path: Path, log: Path) -> None:
    launch = tmp_path / "a.toml"
    for option in ("rate = 1e-300", f"rate = {'9' * 5000}", f"max_frames = {'9' * 5000}"):
        launch.write_text(f'[[node]]\nname = "eye"\nkind = "camera"\n[node.options]\nlog = "{log}"\n{option}\n')
        code, said = run_here("up", launch)
        assert code == 1 and "error: " in said and "a.toml" in said, said
