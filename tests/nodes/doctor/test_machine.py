"""What ``doctor`` says of devices, clocks, ports, sockets and limits; devices are files of the test's own."""

from __future__ import annotations

import importlib.util
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from semantic_mapper.nodes.doctor import machine as doctor
from semantic_mapper.nodes.doctor import robot as doctor_robot
from semantic_mapper.nodes.doctor.check import Check


def only(checks: object) -> Check:
    (check,) = list(checks)  # type: ignore[call-overload]
    return check


def test_devices_that_may_not_be_opened_are_bad_and_the_group_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor_robot, "DEV", tmp_path)
    assert only(doctor_robot.cameras()).state == "note"
    device = tmp_path / "video0"
    device.touch(mode=0o660)
    assert only(doctor_robot.cameras()).state == "ok"
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may open everything
    monkeypatch.setattr(doctor_robot, "_group_of", lambda path: "video")
    shut = only(doctor_robot.cameras())
    assert shut.state == "bad" and str(device) in shut.found and "usermod -aG video" in shut.mend


@pytest.mark.parametrize(
    ("examine", "vendor", "rule", "file"),
    [
        (doctor_robot.oak, "03e7", doctor_robot.OAK_RULE, "80-movidius.rules"),
        (doctor_robot.realsense, "8086", doctor_robot.REALSENSE_RULE, "99-realsense.rules"),
    ],
)
def test_the_rule_for_a_depth_camera_is_looked_for_and_given(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    examine: Callable[[], Iterator[Check]],
    vendor: str,
    rule: str,
    file: str,
) -> None:
    monkeypatch.setattr(doctor_robot, "UDEV_FOLDERS", (tmp_path / "none", tmp_path))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    (tmp_path / "10-gone.rules").symlink_to(tmp_path / "nowhere")
    (tmp_path / "20-folder.rules").mkdir()
    missing = only(examine())
    assert missing.state == "note" and f'ATTRS{{idVendor}}=="{vendor}"' in missing.mend
    (tmp_path / file).write_text(rule + "\n")
    found = only(examine())
    assert found.state == "ok" and found.found.endswith(file)


def test_the_extra_for_a_realsense_is_named_and_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    told = only(doctor_robot.realsense())
    assert told.state == "ok" and "pip install 'semantic-mapper[realsense]'" in told.found


def test_a_clock_that_is_set_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "moved by" not in only(doctor_robot.clocks()).found
    wall = iter((100.0, 103.0))
    monkeypatch.setattr(time, "time", lambda: next(wall))
    jumped = only(doctor_robot.clocks())
    assert jumped.state == "note" and "the wall clock moved by +2." in jumped.found and jumped.mend


def test_who_keeps_the_clock_is_told_and_not_taken_for_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_robot, "JUMP_WATCH_S", 0.0)
    monkeypatch.setattr(doctor_robot, "TIMESYNC", tmp_path / "timesync")
    file = tmp_path / "chronyd.pid"
    monkeypatch.setattr(doctor_robot, "CLOCK_KEEPERS", (("chronyd", "chronyc tracking", (file,)),))
    assert "nobody says" in only(doctor_robot.clocks()).found
    (tmp_path / "timesync").mkdir()
    apart = only(doctor_robot.clocks())
    assert (apart.state, apart.found) == ("note", "steady, not synchronised") and apart.mend
    file.touch()  # it runs, and may be without a network
    assert only(doctor_robot.clocks()).found.startswith("steady, chronyd runs (`chronyc tracking` says whether")
    (tmp_path / "timesync" / "synchronized").touch()
    assert only(doctor_robot.clocks()).found == "steady, synchronised"


def test_a_port_that_somebody_has_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        monkeypatch.setattr(doctor_robot, "PORTS", (port,))
        taken = only(doctor_robot.ports())
    assert taken.state == "note" and str(port) in taken.found and f":{port}" in taken.mend
    assert only(doctor_robot.ports()).state == "ok"


def test_sockets_that_a_killed_process_left_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path_factory) -> None:
    folder = Path(os.path.realpath(f"/tmp/sm-{os.getpid()}"))
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    place = folder / "semantic-mapper" / "default"
    try:
        assert only(doctor_robot.left_sockets()).state == "ok"
        with socket.socket(socket.AF_UNIX) as living:
            living.bind(str(place / "camera"))
            living.listen()
            with socket.socket(socket.AF_UNIX) as dead:
                dead.bind(str(place / "mapper"))
                dead.listen()
            found = only(doctor_robot.left_sockets())
        assert found.state == "note" and found.found.startswith("mapper in ") and "rm " in found.mend
    finally:
        for path in sorted(folder.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        folder.rmdir()


def test_limits_are_read_and_low_ones_told(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [c.name for c in doctor_robot.room()]
    assert names[:3] == ["scratch", "shared memory", "open files"]
    limits = {resource.RLIMIT_NOFILE: (64, 64), resource.RLIMIT_AS: (4_000_000_000, 4_000_000_000)}
    monkeypatch.setattr(resource, "getrlimit", lambda which: limits[which])
    by_name = {c.name: c for c in doctor_robot.room()}
    assert by_name["open files"].state == "note" and "ulimit -n 1024" in by_name["open files"].mend
    assert by_name["address space"].found == "limited to 4.0 GB"


def test_packages_are_checked_with_their_versions_and_without_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    requires = ["open3d<0.21,>=0.20", "torch>=2.5", "rich", 'rerun-sdk; extra == "viewer"', "no-such-package>=1"]
    versions = {"open3d": "0.21.0", "torch": "2.5.1+cpu", "rich": "13"}

    def version(name: str) -> str:
        if name not in versions:
            raise doctor.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requires)
    monkeypatch.setattr(doctor.metadata, "version", version)
    told = " ".join(f"{check.state} {check.found} {check.mend}" for check in doctor._packages())
    assert "open3d 0.21.0, not <0.21,>=0.20" in told and "no-such-package" in told
    assert "torch 2.5.1+cpu, not" not in told and "rerun-sdk" not in told
