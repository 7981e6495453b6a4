"""Launch files that come with the package, in a checkout and in a wheel."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from semantic_mapper.config import load_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.supervisor.launch_config import LaunchFile
from semantic_mapper.nodes.supervisor.packaged_files import UNIT, find_launch, launch_files
from tests.nodes.support import error_line, run, run_here

TOP = Path(__file__).resolve().parents[3]
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

    listed = json.loads(command("launch", "list", "--json").stdout)
    assert set(listed) == set(launch_files())
    assert all(Path(path).is_relative_to(installed) and Path(path).is_file() for path in listed.values())
    done = command("up", "replay")
    assert done.returncode == 1 and f"{installed}/semantic_mapper/launch_files/replay.toml" in error_line(done.stderr)
    assert "--set log=" in done.stderr


def test_files_that_are_there_come_before_those_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "replay").mkdir()  # a folder of that name is no launch file
    for name in ("replay", "replay.toml"):
        assert load_config(find_launch(Path(name)), LaunchFile).node
    (tmp_path / "replay.toml").touch()
    assert find_launch(Path("replay.toml")) == Path("replay.toml")
    for name in ("replai", "elsewhere/replay", UNIT, "../replay"):
        with pytest.raises(ConfigError, match=r"no such file; launch files that come with the package: .*replay"):
            find_launch(Path(name))


def test_launch_files_are_listed_shown_and_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, said = run_here("launch", "list")
    assert code == 0 and all(name in said for name in launch_files())
    assert "goes through the same processes as a live camera would" in said and "would:" not in said, "one sentence"
    shown = run("launch", "show", "replay")
    assert shown.stdout == (TOP / "launch" / "replay.toml").read_text(encoding="utf-8")
    assert run_here("launch", "copy", "oak", "robot.toml") == (0, "robot.toml")
    assert (tmp_path / "robot.toml").read_bytes() == (TOP / "launch" / "oak.toml").read_bytes()
    assert run_here("launch", "copy", UNIT)[0] == 0 and (tmp_path / UNIT).is_file()
    code, said = run_here("launch", "copy", "oak", "robot.toml")
    assert code == 1 and "exists already" in said
    code, said = run_here("launch", "show", "nothing")
    assert code == 1 and "launch files that come with the package" in said
