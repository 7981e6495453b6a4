"""Launch files that come with the package, in a checkout and in a wheel."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.nodes.support import error_line

TOP = Path(__file__).resolve().parents[2]
SOURCES = ("semantic_mapper", "drivers", "nodes", "replay", "launch")


def test_a_wheel_holds_launch_files_that_its_command_finds_by_name_and_no_research(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    source, installed, launch = tmp_path / "source", tmp_path / "installed", TOP / "launch"
    source.mkdir()
    for name in SOURCES:
        shutil.copytree(TOP / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(TOP / name, source)
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(tmp_path)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    wanted = {p.relative_to(launch): p.read_bytes() for p in launch.rglob("*") if p.is_file()}
    packaged = installed / "semantic_mapper" / "launch_files"
    assert {p.relative_to(packaged): p.read_bytes() for p in packaged.rglob("*") if p.is_file()} == wanted
    assert not (installed / "research").exists() and (installed / "semantic_mapper" / "demo.mcap").exists()
    assert not (installed / "launch").exists()  # a package of that name would fight ROS 2's

    program = (
        f"import sys; sys.path.insert(0, {str(installed)!r}); from semantic_mapper.nodes.cli import main; main.main()"
    )
    command = [sys.executable, "-P", "-c", program, "up", "replay"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and f"{packaged}/replay.toml" in error_line(done.stderr)
    assert "--set camera.log=" in done.stderr
