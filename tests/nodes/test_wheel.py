"""Launch files that come with the package, in a checkout and in a wheel."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.nodes.support import error_line

TOP = Path(__file__).resolve().parents[2]
SOURCES = ("semantic_mapper", "drivers", "nodes", "replay", "launch")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the wheel holds, without the packages that it needs."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        shutil.copytree(TOP / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(TOP / name, source)
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(folder)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"


def test_the_wheel_holds_launch_files_the_unit_and_no_research(installed: Path) -> None:
    wanted = {p.relative_to(TOP / "launch"): p.read_bytes() for p in (TOP / "launch").rglob("*") if p.is_file()}
    packaged = installed / "semantic_mapper" / "launch_files"
    assert {p.relative_to(packaged): p.read_bytes() for p in packaged.rglob("*") if p.is_file()} == wanted
    assert not (installed / "research").exists()
    assert (installed / "semantic_mapper" / "demo.mcap").exists()
    assert not (installed / "launch").exists()  # a package of that name would fight ROS 2's


def test_an_installed_command_finds_them_by_name(installed: Path, tmp_path: Path) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(installed)!r}); from semantic_mapper.nodes.cli.main import main; main()"
    )

    def command(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-c", code, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )

    done = command("up", "replay")
    assert done.returncode == 1 and f"{installed}/semantic_mapper/launch_files/replay.toml" in error_line(done.stderr)
    assert "--set camera.log=" in done.stderr
