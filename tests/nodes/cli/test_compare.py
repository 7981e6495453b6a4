"""``compare``: tables, tolerances and exit codes, on folders that ``replay`` has written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import pytest

from tests.nodes.support import error_line, run


@pytest.fixture(scope="module")
def fewer(log: Path, weights: Path, config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of the same log without its last frame."""
    out = tmp_path_factory.mktemp("fewer") / "out"
    done = run("replay", log, "--out", out, "--weights", weights, "--config", config, "--max-frames", "5")
    assert done.returncode == 0, done.stderr
    return out


def test_a_run_and_its_copy_are_equal_to_the_bit(replayed: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(replayed, tmp_path / "copy")
    done = run("compare", replayed, copy, "--exact", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["equal"] and found["exact"] and found["fields"]["bits"]["difference"] == 0
    assert found["picture"] == str(copy / "compare.png") and cv2.imread(found["picture"]).std() > 10


def test_a_missing_frame_differs_and_is_in_table_and_json(replayed: Path, fewer: Path, tmp_path: Path) -> None:
    picture = tmp_path / "pictures" / "where.png"
    done = run("compare", replayed, fewer, "--picture", picture)
    assert done.returncode == 1, done.stderr
    assert "frames_mapped" in done.stdout and "different: frames_published, frames_mapped" in done.stdout
    assert picture.exists() and not (fewer / "compare.png").exists()
    done = run("compare", replayed, fewer, "--picture", picture, "--json")
    field = json.loads(done.stdout)["fields"]["frames_mapped"]
    assert done.returncode == 1 and (field["a"], field["b"], field["within"]) == (6, 5, False)


def test_tolerances_come_from_a_file_and_from_options_which_win(replayed: Path, fewer: Path, tmp_path: Path) -> None:
    names = json.loads(run("compare", replayed, fewer, "--json").stdout)["fields"]
    file = tmp_path / "loose.toml"
    file.write_text("".join(f"{name} = inf\n" for name in names if name != "frames_mapped") + "frames_mapped = 1\n")
    done = run("compare", replayed, fewer, "--tolerances", file, "--json")
    assert done.returncode == 0 and list(json.loads(done.stdout)["fields"]) == ["frames_mapped"]
    assert run("compare", replayed, fewer, "--tolerances", file, "-t", "frames_mapped=0").returncode == 1


def test_maps_alone_can_be_compared(replayed: Path, fewer: Path) -> None:
    done = run("compare", replayed / "map.npz", fewer / "map.npz", "-t", "frames_mapped=1", "--json")
    found = json.loads(done.stdout)
    assert "miou" not in found["fields"] and found["fields"]["frames_mapped"]["within"]
    assert found["picture"] == str(fewer / "compare.png")
    assert "is a map alone" in found["notes"][0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("-t", "lables=0.1"), "did you mean `labels`"),
        (("-t", "labels"), "write FIELD=VALUE"),
        (("-t", "labels=-1"), "labels"),
        (("--tolerances", "gone.toml"), "gone.toml: no such file"),
    ],
)
def test_wrong_tolerances_are_wrong_usage(replayed: Path, arguments: tuple[str, ...], said: str) -> None:
    done = run("compare", replayed, replayed, *arguments)
    assert done.returncode == 2 and said in error_line(done.stderr) and not done.stdout


def test_what_cannot_be_read_is_no_difference(replayed: Path, tmp_path: Path) -> None:
    done = run("compare", replayed, tmp_path / "gone")
    assert done.returncode == 2 and "no such map file" in error_line(done.stderr)
    broken = shutil.copytree(replayed, tmp_path / "broken")
    (broken / "map.npz").write_bytes((replayed / "map.npz").read_bytes()[:-100])
    done = run("compare", broken, replayed)
    assert done.returncode == 2 and "map.npz" in error_line(done.stderr)


def test_exact_leaves_nothing_to_tolerate(replayed: Path) -> None:
    done = run("compare", replayed, replayed, "--exact", "-t", "labels=1")
    assert done.returncode == 2 and "--exact" in done.stderr


def test_logs_are_refused_with_how_to_make_what_can_be_compared(log: Path, replayed: Path) -> None:
    for a, b in ((log, replayed), (replayed, log)):
        done = run("compare", a, b)
        assert done.returncode == 2
        assert (
            f"is a log, and `compare` takes maps or results of runs: `semantic-mapper replay {log} --out FOLDER`"
            in (error_line(done.stderr))
        )
