"""The sample robot, and the robot of the how-to: they go by the map of a launch that runs."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from tests.nodes.support import TIMEOUT_S, Running, run_ok

ROOT = Path(__file__).resolve().parents[2]
ROBOT = ROOT / "examples" / "robot"


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Launches here are alone; its path is short enough for their sockets."""
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        monkeypatch.setattr(tempfile, "tempdir", folder)
        monkeypatch.setenv("PYTHONPATH", str(ROOT))
        yield Path(folder)


def python(*arguments: str | Path, cwd: Path = ROOT) -> str:
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_its_own_tests_pass(tmp_path: Path) -> None:
    plugins = ("-p", "semantic_mapper.testing", "-p", "no:dash", "-p", "no:cacheprovider")
    assert "4 passed" in python("-m", "pytest", "-q", *plugins, "--basetemp", tmp_path / "tests", cwd=ROBOT)


@pytest.mark.slow
def test_robots_find_the_chair_of_a_room_while_it_is_mapped(folder: Path) -> None:
    howto = (ROOT / "docs" / "robots.md").read_text(encoding="utf-8").split("## Ask the map")[1]
    (folder / "robot.py").write_text(howto.split("```python\n")[1].split("```")[0])
    log = ROOT / "semantic_mapper" / "demo.mcap"
    options = ("--set", f"camera.log={log}", "--set", "camera.loop=true", "--out", folder / "out")
    with Running("up", "camera", *options) as launch:
        launch.wait_for_line("stream_begins")
        driven = python(ROBOT / "robot.py", "chair", "2.2", "0.3", "0", "--picture", folder / "path.png")
        assert python(folder / "robot.py").startswith("drive to [")
        assert "points" in run_ok("export", "live", "--out", folder / "now.ply").stdout
    assert driven.count("chair") > 2 and "arrived" in driven and cv2.imread(str(folder / "path.png")) is not None
