"""What the virtual machine for the V4L2 driver is made of; `make test-v4l2` boots it."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from research.experiments import v4l2_machine


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(v4l2_machine, "TREE", tmp_path / "tree")
    return v4l2_machine


def add_module(tree: Path, name: str, depends: str) -> None:
    folder = tree / "lib" / "modules" / "6.1" / "kernel" / "drivers"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.ko").write_bytes(b"\x7fELF\0license=GPL\0depends=" + depends.encode() + b"\0name=x\0")


def test_modules_are_loaded_after_those_that_they_need(script: ModuleType) -> None:
    add_module(script.TREE, "vivid", "videobuf2-v4l2,videodev,builtin")
    add_module(script.TREE, "videobuf2-v4l2", "videodev,mc")
    add_module(script.TREE, "videodev", "mc")
    add_module(script.TREE, "mc", "")
    assert script.with_dependencies(("vivid", "mc")) == ["mc", "videodev", "videobuf2_v4l2", "vivid"]


def test_the_archive_reads_back_as_the_kernel_reads_it(script: ModuleType) -> None:
    files = {"bin": b"", "init": b"#!/bin/busybox sh\n", "odd": b"12345"}
    archive = b"".join(script.cpio_entry(name, data, 0o100755) for name, data in files.items())
    read: dict[str, bytes] = {}
    at = 0
    while at < len(archive):
        assert archive[at : at + 6] == b"070701"
        fields = [int(archive[at + 6 + 8 * i : at + 14 + 8 * i], 16) for i in range(13)]
        size, name_size = fields[6], fields[11]
        assert fields[1] == 0o100755
        name = archive[at + 110 : at + 110 + name_size - 1].decode()
        data_at = (at + 110 + name_size + 3) // 4 * 4
        read[name] = archive[data_at : data_at + size]
        at = (data_at + size + 3) // 4 * 4
    assert read == files


def test_without_packages_to_fetch_it_is_skipped_with_the_reason(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr(script.platform, "machine", lambda: "x86_64")
    assert script.main() == 0
    assert "skipped: this system has no apt-get" in capsys.readouterr().err
