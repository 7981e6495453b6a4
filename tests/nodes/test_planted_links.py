"""Links that somebody has put into a folder of results are replaced: nothing is written through them."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from semantic_mapper.replay.run_folder import hold_folder
from tests.nodes.support import run_here

RESULTS = ("overview.png", "map.npz", "map.ply", "report.html", "summary.json", "eval.json", "eval.html")


def test_no_result_is_written_through_a_link(
    tmp_path: Path, log: Path, weights: Path, config: Path, replayed: Path
) -> None:
    target, out = tmp_path / "precious", tmp_path / "out"
    target.write_bytes(b"precious")
    out.mkdir()
    for name in RESULTS:
        for link in (name, name + ".part", "part." + name):
            (out / link).symlink_to(target)
    (out / ".writable").symlink_to(tmp_path / "made")
    for arguments in (
        ("replay", log, "--out", out, "--weights", weights, "--config", config),
        ("eval", out),
        ("compare", replayed, out),
    ):
        code, said = run_here(*arguments)
        assert code in (0, 1) and "Traceback" not in said, said
        assert target.read_bytes() == b"precious", arguments
    assert not (tmp_path / "made").exists()
    assert all((out / name).is_file() and not (out / name).is_symlink() for name in RESULTS)


def test_a_run_removes_what_a_killed_one_left_in_its_folder(tmp_path: Path) -> None:
    code = (
        "import os, signal; from pathlib import Path; from semantic_mapper.files import atomic_write\n"
        f"with atomic_write(Path({str(tmp_path / 'map.npz')!r})): os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    with hold_folder(tmp_path):
        assert list(tmp_path.iterdir()) == []
