"""Links that somebody has put into a folder of results are replaced: nothing is written through them."""

from __future__ import annotations

from pathlib import Path

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
