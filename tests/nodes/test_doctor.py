"""What ``doctor`` says of this machine's packages and cameras, and of a launch file and what it names."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.nodes import doctor
from semantic_mapper.nodes.doctor import Check
from semantic_mapper.transport.keys import allow, make_keys
from tests.nodes.support import REPLAY_LAUNCH, error_line, run

ROBOT = REPLAY_LAUNCH.with_name("onboard.toml")


def of(path: Path, *settings: str) -> dict[str, Check]:
    return {check.name: check for check in doctor.examine_launch(path, settings)}


def test_launch_file_that_up_would_refuse_is_bad(tmp_path: Path) -> None:
    refused = of(REPLAY_LAUNCH)["replay.toml"]
    assert refused.state == "bad" and "needs 'log'" in refused.found and "--set camera.log=" in refused.fix
    assert of(tmp_path / "none.toml")["none.toml"].state == "bad"


def test_keys_that_a_launch_file_names_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "keys"
    settings = [f"keys={folder}", "mapper.query=tcp://0.0.0.0:0"]
    none = of(ROBOT, *settings)["keys"]
    assert (none.state, none.fix) == ("bad", f"make them with `semantic-mapper keys make --keys {folder}`")
    make_keys(folder)
    alone = of(ROBOT, *settings)["keys"]
    assert alone.state == "note" and "keys allow" in alone.fix
    allow(folder, "desk", make_keys(tmp_path / "desk").public.decode())
    assert of(ROBOT, *settings)["keys"] == Check("keys", "ok", f"{folder}: this machine's, and those of desk")
    secret = next(folder.glob("*.key_secret"))
    secret.chmod(0o644)
    assert f"chmod 600 {secret}" in of(ROBOT, *settings)["keys"].fix
    for place, state in ((tmp_path / "nowhere", "ok"), (folder, "bad")):
        monkeypatch.setattr(doctor, "user_key_folder", lambda place=place: place)
        assert [c.state for c in doctor.own_keys()] == [state]


def test_what_a_node_would_refuse_as_it_starts_is_told_before(tmp_path: Path) -> None:
    found = of(REPLAY_LAUNCH, f"camera.log={tmp_path / 'none.mcap'}")
    assert (found["camera"].state, found["mapper"].state) == ("bad", "ok")
    assert "no such log" in found["camera"].found
    assert "fps" in of(ROBOT, "camera.config.fps=-1")["camera"].found
    (tmp_path / "mapper.toml").write_text("[voxel_map]\nvoxel_size = 0.1\n", encoding="utf-8")
    (tmp_path / "broken.safetensors").write_bytes(b"no weights")
    weights = tmp_path / "broken.safetensors"
    settings = (f"mapper.config={tmp_path / 'mapper.toml'}", f"finetuner.weights={weights}", "camera.poses.kind=visual")
    found = of(ROBOT.with_name("learning.toml"), *settings)
    assert "begin in another world" in found["camera"].found
    assert "voxel_size" in found["mapper"].found and "broken.safetensors" in found["finetuner"].found


def test_a_camera_that_is_not_connected_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    connected: list[FoundCamera] = []
    monkeypatch.setattr(doctor, "find_cameras", lambda kinds: (connected, {}))
    found = "camera 'camera': no oak camera is connected"
    assert of(ROBOT)["camera"] == Check("camera", "bad", found, "plug it in (`up` waits for it)")
    connected.append(FoundCamera("oak", "OAK-D", "1844"))
    assert of(ROBOT)["camera"] == Check("camera", "ok", "oak 1844; its settings and poses")
    assert "oak 17 is not connected, there are 1844" in of(ROBOT, "camera.config.device=17")["camera"].found
    assert of(ROBOT, "camera.config.device=10.0.0.2")["camera"].state == "ok", "it may lie behind a router"


def test_packages_are_checked_with_their_versions_and_without_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    requires = ["open3d<0.21,>=0.20", "torch>=2.5", "rich", 'rerun-sdk; extra == "viewer"', "no-such-package>=1"]
    versions = {"open3d": "0.21.0", "torch": "2.5.1+cpu", "rich": "13"}

    def version(name: str) -> str:
        if name not in versions:
            raise doctor.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requires)
    monkeypatch.setattr(doctor.metadata, "version", version)
    (told,) = doctor._packages()
    assert "open3d 0.21.0, not <0.21,>=0.20" in told.found and "no-such-package" in told.found
    assert "torch 2.5.1+cpu, not" not in told.found and "rerun-sdk" not in told.found


def test_cameras_are_listed_as_a_table_and_as_json() -> None:
    told = run("doctor", "--cameras", "--kind", "v4l2", "--kind", "opencv", "--json")
    found = json.loads(told.stdout)
    assert set(found) == {"cameras", "unknown"} and found["unknown"] == {}
    table = run("doctor", "--cameras", "--kind", "v4l2")
    assert all(c["address"] in table.stdout for c in found["cameras"]) or "no camera is connected" in table.stdout
    done = run("doctor", "--cameras", "--kind", "v4l")
    assert done.returncode == 1 and "did you mean 'v4l2'?" in error_line(done.stderr)
