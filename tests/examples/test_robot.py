"""The sample robot: its own tests pass, and it follows and asks a mapper that runs beside it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.nodes.support import TIMEOUT_S, eventually, repeated_frames, write_log

ROOT = Path(__file__).resolve().parents[2]
ROBOT = ROOT / "examples" / "robot"
FRAMES = 60
SEEN = re.compile(
    r"frame (\d+): (\d+) blocks, (?:wall at ([\d.]+) m; [-\d. ]+ is (free|not known to be free)|no wall yet)"
)


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    """Sockets in a folder of their own; its path is short enough for one."""
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        yield {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": folder}


@pytest.mark.slow
def test_its_own_tests_pass(environment: dict[str, str], tmp_path: Path) -> None:
    plugins = ("-p", "semantic_mapper.testing", "-p", "no:dash", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", "-q", *plugins, "--basetemp", str(tmp_path / "tests")]
    done = subprocess.run(command, cwd=ROBOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "3 passed" in done.stdout, done.stdout + done.stderr


@contextmanager
def process(*arguments: str, env: dict[str, str], output: Path) -> Iterator[subprocess.Popen[bytes]]:
    with output.open("wb") as file:
        running = subprocess.Popen([sys.executable, *arguments], cwd=ROOT, env=env, stdout=file, stderr=file)
        try:
            yield running
        finally:
            running.kill()
            running.wait()


def node(kind: str, **options: object) -> tuple[str, ...]:
    return "-m", f"semantic_mapper.nodes.{kind}", json.dumps({"name": kind, "options": options})


@pytest.mark.slow
def test_it_follows_a_running_mapper_and_asks_it(environment: dict[str, str], tmp_path: Path) -> None:
    log = write_log(tmp_path / "room.mcap", repeated_frames(FRAMES))
    config = tmp_path / "mapper.toml"
    config.write_text('quality = "fast"\n[voxel_map]\nvoxel_size_m = 0.05\n')
    outputs = {name: tmp_path / f"{name}.txt" for name in ("mapper", "robot", "camera")}
    with ExitStack() as stack:

        def start(name: str, *arguments: str) -> subprocess.Popen[bytes]:
            return stack.enter_context(process(*arguments, env=environment, output=outputs[name]))

        mapper = start("mapper", *node("mapper", out=str(tmp_path / "out"), config=str(config)))
        assert eventually(lambda: "ready" in outputs["mapper"].read_text() or mapper.poll() is not None)
        robot = start("robot", str(ROBOT / "robot.py"), "wall", "0", "0", "1")
        assert eventually(lambda: "following" in outputs["robot"].read_text() or robot.poll() is not None)
        camera = start("camera", *node("camera", log=str(log)))
        for running in (camera, mapper, robot):
            assert running.wait(TIMEOUT_S) == 0, "\n".join(path.read_text() for path in outputs.values())
    _, *lines = outputs["robot"].read_text().splitlines()
    seen = [found.groups() for line in lines if (found := SEEN.fullmatch(line))]
    assert len(seen) == len(lines) >= 3, lines
    numbers = [int(seq) for seq, *_ in seen]
    assert numbers == sorted(set(numbers)) and numbers[-1] < FRAMES
    assert int(seen[-1][1]) == VoxelMap.load(tmp_path / "out" / "map.npz").block_count
    assert seen[-1][2] is not None and 0 < float(seen[-1][2]) < 5
