"""Wheels of all machines: what the check finds, and that the real ones pass it."""

import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tools.wheels import LIBRARIES, ROOT, UV, find_problems

GOOD = "semantic_mapper-0.1.0-py3-none-manylinux_2_28_aarch64.whl"
DIGEST = "0123abcd"


def library(number: int, digest: str = DIGEST) -> bytes:
    """The header of a shared library for an ELF machine, and a digest."""
    header = b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HH", 3, number)
    return header.ljust(64, b"\0") + digest.encode()


def problems(folder: Path, files: dict[str, bytes], name: str = GOOD) -> list[str]:
    wheel = folder / name
    tag = "-".join(wheel.stem.split("-")[2:])
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("semantic_mapper-0.1.0.dist-info/WHEEL", f"Wheel-Version: 1.0\nTag: {tag}\n")
        for path, content in files.items():
            archive.writestr(path, content)
    return find_problems(wheel, "aarch64", {"kernels-aarch64"}, DIGEST)


def test_what_is_wrong_with_a_wheel_is_found(tmp_path: Path) -> None:
    path = f"{LIBRARIES}kernels-aarch64.so"
    assert problems(tmp_path, {path: library(183)}) == []
    assert "libraries []" in problems(tmp_path, {})[0]
    more = {path: library(183), f"{LIBRARIES}kernels-x86_64.so": library(183)}
    assert "kernels-x86_64.so" in problems(tmp_path, more)[0]
    assert problems(tmp_path, {path: library(62)}) == [f"{path} is compiled for x86_64"]
    assert problems(tmp_path, {path: library(8)}) == [f"{path} is compiled for ELF machine 8"]
    assert "no 64-bit little-endian ELF file" in problems(tmp_path, {path: DIGEST.encode()})[0]
    assert problems(tmp_path, {path: library(183, "4567")}) == [f"{path} is compiled from other sources"]
    (wrong,) = problems(tmp_path, {path: library(183)}, "semantic_mapper-0.1.0-py3-none-linux_aarch64.whl")
    assert "py3-none-linux_aarch64" in wrong


@pytest.mark.slow
@pytest.mark.skipif(not UV.exists(), reason="`make setup` brings uv")
def test_wheels_of_all_machines_are_built_here_and_the_own_one_runs(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "wheels.py"), "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    names = sorted(path.name for path in tmp_path.glob("*.whl"))
    assert [name.rsplit("_28_")[1] for name in names] == ["aarch64.whl", "x86_64.whl"]
