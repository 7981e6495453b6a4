"""The project as a whole: its version, its layers, its house rules."""

import importlib.metadata
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import semantic_mapper

ROOT = Path(__file__).resolve().parent.parent


def pyproject() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_is_the_same_everywhere() -> None:
    declared = pyproject()["project"]["version"]
    assert semantic_mapper.__version__ == declared
    assert importlib.metadata.version("semantic-mapper") == declared
    assert f"## {declared}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_module_can_be_imported_and_none_loads_a_vendor_library() -> None:
    names = ["semantic_mapper"]
    names += [m.name for m in pkgutil.walk_packages([str(ROOT / "semantic_mapper")], "semantic_mapper.")]
    assert "semantic_mapper.nodes.mapper.node" in names
    names = [name for name in names if not name.endswith("__main__")]
    program = (
        "import importlib, sys\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
        "print(sorted({'open3d', 'depthai', 'pyrealsense2', 'rosbags'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-I", "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"  # they load when a device or a map is opened


def test_the_command_line_starts_without_heavy_packages() -> None:
    heavy = {"torch", "open3d", "rerun", "scipy", "cv2", "zmq"}
    program = f"import sys, semantic_mapper.nodes.cli.main; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-I", "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.returncode) == ("[]", 0), done.stderr


def test_no_file_names_a_machine_or_a_package_index() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    foreign = re.compile(
        "|".join(("/" + "root/", "/" + "work/", "/" + r"home/\w", "pypi" + r"\.org", "python" + "hosted"))
    )
    named: list[str] = []
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if (
            name == "uv.lock"
            or path.suffix in {".png", ".jpg", ".safetensors", ".mcap", ".npz", ".keyframe", ".bin", ".msg"}
            or not path.is_file()
        ):
            continue
        found = foreign.search(path.read_text(encoding="utf-8"))
        named += [f"{name}: {found.group()}"] if found else []
    assert not named
