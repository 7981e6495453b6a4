"""What ``doctor`` says of a launch file: its options, the keys that it names, the addresses where it would listen."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.nodes.doctor import launch_file as doctor_launch
from semantic_mapper.nodes.doctor import launch_nodes
from semantic_mapper.nodes.doctor.check import Check
from semantic_mapper.transport.keys import allow, make_keys
from tests.nodes.support import REPLAY_LAUNCH

ROBOT, CAMERA = REPLAY_LAUNCH.with_name("onboard.toml"), REPLAY_LAUNCH.with_name("camera.toml")


def of(path: Path, *settings: str) -> dict[str, list[Check]]:
    found: dict[str, list[Check]] = {}
    for check in doctor_launch.launch_file(path, settings):
        found.setdefault(check.name, []).append(check)
    return found


def test_launch_file_that_up_would_refuse_is_bad(tmp_path: Path) -> None:
    (refused,) = of(REPLAY_LAUNCH)["replay.toml"]
    assert refused.state == "bad" and "needs 'log'" in refused.found and "--set camera.log=" in refused.fix
    assert of(tmp_path / "none.toml")["none.toml"][0].state == "bad"


def test_addresses_are_told_with_who_has_them() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        found = of(ROBOT, f"mapper.query={taken}", "publish=tcp://127.0.0.1:0", "mapper.publish=tcp://127.0.0.1:0")
        everywhere = taken.replace("127.0.0.1", "0.0.0.0")
        assert doctor_launch._port_is_taken(int(taken.rpartition(":")[2]), "0.0.0.0")
    assert [(c.state, c.found) for c in found["address"]] == [
        ("ok", "tcp://127.0.0.1:0"),
        ("note", f"{taken} is in use (by this very launch, if it runs)"),
        ("ok", "tcp://127.0.0.1:0"),
    ]
    assert f"sport = :{taken.rpartition(':')[2]}" in found["address"][1].fix
    (refused,) = [c for c in of(ROBOT, f"mapper.query={everywhere}")["address"] if c.state == "bad"]
    assert "which needs keys" in refused.found + refused.fix


def test_keys_that_a_launch_file_names_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, quiet = tmp_path / "keys", ("publish=tcp://127.0.0.1:0", "mapper.publish=tcp://127.0.0.1:0")
    settings = [f"keys={folder}", "mapper.query=tcp://0.0.0.0:0", *quiet]
    found = of(ROBOT, *settings)
    (none,) = found["keys"]
    assert "address" not in found, "told once"
    assert (none.state, none.fix) == ("bad", f"make them with `semantic-mapper keys make --keys {folder}`")
    own = make_keys(folder)
    found = of(ROBOT, *settings)
    assert found["keys"][0].state == "note" and "keys allow" in found["keys"][0].fix
    assert [c.state for c in found["address"]] == ["ok", "bad", "ok"], "nobody could come in from elsewhere"
    allow(folder, "desk", make_keys(tmp_path / "desk").public.decode())
    found = of(ROBOT, *settings)
    assert found["keys"] == [Check("keys", "ok", f"{folder}: this machine's, and those of desk")]
    assert {c.state for c in found["address"]} == {"ok"}
    secret = next(folder.glob("*.key_secret"))
    secret.chmod(0o644)
    open_to_all = of(ROBOT, *settings)["keys"][0]
    assert open_to_all.state == "bad" and f"chmod 600 {secret}" in open_to_all.fix
    assert own.secret.decode() not in str(of(ROBOT, *settings))

    monkeypatch.setattr(doctor_launch, "user_key_folder", lambda: tmp_path / "nowhere")
    assert [c.state for c in doctor_launch.own_keys()] == ["ok"]
    monkeypatch.setattr(doctor_launch, "user_key_folder", lambda: folder)
    assert [c.state for c in doctor_launch.own_keys()] == ["bad"]


def test_what_a_node_would_refuse_as_it_starts_is_told_before(tmp_path: Path) -> None:
    found = of(REPLAY_LAUNCH, f"camera.log={tmp_path / 'none.mcap'}")
    assert (found["camera"][0].state, found["mapper"][0].state) == ("bad", "ok")
    assert "no such log" in found["camera"][0].found
    assert "fps" in of(ROBOT, "camera.config.fps=-1")["camera"][0].found
    (tmp_path / "mapper.toml").write_text("[voxel_map]\nvoxel_size = 0.1\n", encoding="utf-8")
    (tmp_path / "broken.safetensors").write_bytes(b"no weights")
    weights = tmp_path / "broken.safetensors"
    settings = (f"mapper.config={tmp_path / 'mapper.toml'}", f"finetuner.weights={weights}", "camera.poses.kind=visual")
    found = of(ROBOT.with_name("learning.toml"), *settings)
    assert "begin in another world" in found["camera"][0].found
    assert "voxel_size" in found["mapper"][0].found and "broken.safetensors" in found["finetuner"][0].found
    assert {found[name][0].state for name in ("camera", "mapper", "finetuner")} == {"bad"}


def test_packages_of_bridges_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "semantic_mapper.nodes.foxglove.server", None)
    monkeypatch.delitem(sys.modules, "semantic_mapper.nodes.foxglove.server")
    monkeypatch.setitem(sys.modules, "foxglove", None)
    (missing,) = of(CAMERA, "camera.kind=oak", "foxglove.enabled=true")["foxglove"]
    assert missing.state == "bad" and "semantic-mapper[foxglove]" in missing.found + missing.fix


def test_a_camera_that_is_not_connected_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    connected: list[FoundCamera] = []
    monkeypatch.setattr(launch_nodes, "find_cameras", lambda kinds: (connected, {}))
    found = "camera 'camera': no oak camera is connected"
    assert of(ROBOT)["camera"][0] == Check("camera", "bad", found, "plug it in (`up` waits for it)")
    connected.append(FoundCamera("oak", "OAK-D", "1844"))
    assert of(ROBOT)["camera"][0] == Check("camera", "ok", "oak 1844; its settings and poses")
    assert "oak 17 is not connected, there are 1844" in of(ROBOT, "camera.config.device=17")["camera"][0].found
    assert of(ROBOT, "camera.config.device=10.0.0.2")["camera"][0].state == "ok", "it may lie behind a router"
