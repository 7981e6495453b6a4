"""Launch files: those of the package, what is accepted, what is refused, and how the refusal helps."""

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import semantic_mapper.drivers.poses.config
import semantic_mapper.drivers.registry
from semantic_mapper.config import convert_config
from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.drivers.poses.sources import read_pose_config
from semantic_mapper.drivers.registry import load_driver
from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.camera.live import make_source
from semantic_mapper.nodes.launcher.launch_file import find_launch, launch_files, load_launch
from semantic_mapper.nodes.options import CAMERA_KINDS, POSE_KINDS
from semantic_mapper.types import CameraIntrinsics
from tests.nodes.support import write_log
from tests.small import tiny_frames

EYE = """
[[node]]
name = "eye"
kind = "camera"
[node.options]
log = ""
mode = "realtime"
"""
SMALL = f"""
{EYE}
[[node]]
name = "brain"
kind = "mapper"
[node.options]
input = "eye"
out = "{{out}}/map"
"""


def file_of(folder: Path, text: str) -> Path:
    path = folder / "launch.toml"
    path.write_text(text)
    return path


def shipped(name: str, *settings: str) -> Any:
    """A launch file of the package."""
    return load_launch(find_launch(Path(name)), settings, Path("there"))


def options_of(name: str, *settings: str) -> dict[str, dict[str, Any]]:
    """Options of its nodes, as plain data."""
    return {node: msgspec.to_builtins(options) for node, options in shipped(name, *settings).options.items()}


def test_a_log_goes_through_in_lockstep_and_in_a_live_launch_in_its_own_time() -> None:
    nodes = options_of("replay", "camera.log=room.mcap")
    assert nodes.keys() == {"mapper", "camera"} and nodes["mapper"]["out"] == "there"
    assert (nodes["camera"]["mode"], nodes["mapper"]["delivery"]) == ("lockstep", "all")
    launch = shipped("replay.toml", "camera.log=room.mcap", "recorder.enabled=true")
    assert {node.restart for node in launch.nodes} == {"never"} and launch.listeners("camera") == 2
    for name in ("camera", "learning"):
        nodes = options_of(name, "camera.log=room.mcap")
        assert (nodes["camera"]["camera"], nodes["camera"]["mode"]) == (None, "realtime")
    launch = shipped("camera", "camera.log=room.mcap", "mapper.restart=never")
    assert {node.name: node.restart for node in launch.nodes} == {"mapper": "never", "camera": "on-failure"}


@pytest.mark.parametrize(
    ("kind", "settings", "config", "poses"),
    [
        ("oak", ["device=1844301078", "fps=15"], {"device": "1844301078", "fps": 15, "odometry": True}, "device"),
        ("realsense", ["device=0123", "fps=15"], {"device": "0123", "fps": 15}, "rgbd"),
        ("stereo", ["device=/dev/video1", "calibration=pair.toml"], {"calibration": "pair.toml"}, "rgbd"),
        ("v4l2", ["device=/dev/video3", "exposure_ms=8"], {"device": "/dev/video3", "exposure_ms": 8.0}, "topic"),
        ("opencv", ["source=film.mp4", "pace=fast"], {"source": "film.mp4", "pace": "fast"}, "visual"),
    ],
)
def test_settings_fit_driver_and_poses(kind: str, settings: list[str], config: dict[str, object], poses: str) -> None:
    given = [f"camera.config.{text}" for text in settings]
    if poses in ("topic", "visual"):  # the others are those that this kind of camera has without being given any
        given += [f"camera.poses.kind={poses}"]
        given += ["camera.poses.endpoint=tcp://127.0.0.1:5560"] if poses == "topic" else []
    nodes = options_of("camera", *given, f"camera.kind={kind}", "mapper.weights=007")
    live = nodes["camera"]["camera"]
    made = convert_config(live["config"], load_driver(kind).Config, "test")
    assert live["kind"] == kind and {key: getattr(made, key) for key in config} == config
    assert read_pose_config(live["poses"]).kind == poses and nodes["mapper"]["weights"] == "007"
    closes_loops = poses == "rgbd"
    assert nodes["mapper"]["history_frames"] == 3000 * closes_loops
    assert nodes["camera"]["corrections"] == "query" * closes_loops


def test_values_are_read_as_their_setting_wants_them(tmp_path: Path) -> None:
    given = ["eye.log=/data/a = b.mcap", "eye.rate=2.5", "brain.save_every_s=3", 'brain.weights="a b"']
    launch = load_launch(file_of(tmp_path, SMALL), [*given, 'brain.input=["eye"]', "heartbeat_s=2"])
    eye, brain = (msgspec.to_builtins(launch.options[name]) for name in ("eye", "brain"))
    assert (eye["log"], eye["rate"], brain["save_every_s"], brain["weights"]) == ("/data/a = b.mcap", 2.5, 3.0, "a b")
    assert brain["input"] == ("eye",) and launch.file.heartbeat_s == 2
    for text in ("1844301078", "123E45", "true"):
        assert load_launch(file_of(tmp_path, SMALL), [f"eye.log={text}"]).options["eye"].log == text  # type: ignore[union-attr]


def test_finetuner_foxglove_and_keys_fit_the_nodes_of_their_launch() -> None:
    launch = shipped("learning", "camera.log=x", "finetuner.cpu_fraction=0.25")
    mapper, finetuner = launch.options["mapper"], launch.options["finetuner"]
    assert finetuner.cpu_fraction == 0.25 and finetuner.niceness == 19
    assert (finetuner.inputs(), mapper.inputs()) == (("mapper",), ("camera", "finetuner"))
    assert finetuner.out == mapper.out == "there" and finetuner.weights == mapper.weights
    assert {"labels", "query", "finetuner"} <= set(launch.sockets()) and launch.listeners("camera") == 1
    given = ["camera.kind=v4l2", "camera.config=webcam.toml", "camera.poses=poses.toml", "foxglove.enabled=true"]
    launch = shipped("camera", *given, "mapper.query=ask", "mapper.keys=k")
    foxglove = launch.options["foxglove"]
    assert (foxglove.inputs(), foxglove.query, foxglove.keys) == (("camera", "mapper"), "ask", "k")
    assert launch.listeners("camera") == 2
    with pytest.raises(ConfigError, match="node 'foxglove' shows the map of 'camera', which is no mapper"):
        shipped("camera", *given, "foxglove.mapper=camera")
    nodes = options_of("onboard", "keys=k", "publish=tcp://127.0.0.1:7")
    assert nodes["mapper"]["keys"] == "k" and nodes["mapper"]["query"].startswith("tcp://127.0.0.1:")
    launch = shipped("onboard", "keys=k", "mapper.keys=own", "publish=tcp://127.0.0.1:7")
    assert (launch.file.publish, launch.file.keys, launch.options["mapper"].keys) == ("tcp://127.0.0.1:7", "k", "own")
    assert launch.sockets() == ("launch", "mapper", "camera", "recorder")
    assert {node.restart for node in launch.nodes} == {"on-failure"} and launch.file.heartbeat_s == 1.5


def test_several_cameras_fit_drivers_poses_and_calibrations(tmp_path: Path) -> None:
    T = np.eye(4)
    T[0, 3] = 0.12
    given: list[str] = []
    for name in ("left", "right"):
        save_calibration(tmp_path / f"{name}.toml", CameraIntrinsics(500.0, 500.0, 319.5, 239.5, 640, 480), T, {})
        given += [f"{name}.config.device=/dev/{name}", f"{name}.config.calibration={tmp_path}/{name}.toml"]
    launch = shipped("multi-camera", *given)
    assert launch.options["mapper"].inputs() == ("left", "right")
    assert launch.listeners("left") == launch.listeners("right") == 2
    for name in ("left", "right"):
        camera = launch.options[name].camera
        assert camera.id == name
        make_source(camera)  # not open yet; would refuse what does not fit


def test_mistakes_with_several_cameras_are_named(tmp_path: Path) -> None:
    text = launch_files()["multi-camera"].read_text(encoding="utf-8")
    for old, new, says in (
        ('id = "right"', 'id = "left"', "cameras of node 'mapper', 'left' and 'right', have the id 'left'"),
        ('input = ["left", "right"]', 'input = ["left", "recorder"]', "'recorder', which is no camera"),
        ("streams = 2", "streams = 3", "'mapper', which is no camera"),
    ):
        assert old in text
        with pytest.raises(ConfigError, match=says):
            load_launch(file_of(tmp_path, text.replace(old, new)))
    one, other = (write_log(tmp_path / name, tiny_frames(2)) for name in ("one.mcap", "other.mcap"))
    path = file_of(tmp_path, EYE.replace("eye", "second") + SMALL.replace('"eye"\nout', '["eye", "second"]\nout'))
    with pytest.raises(ConfigError, match=r"'eye' and 'second', have the id 'rooms'; frames of a log keep.*own"):
        load_launch(path, [f"eye.log={one}", f"second.log={other}"])
    live = [f"eye.log={one}", "second.kind=v4l2", "second.poses.kind=fixed", "second.id=other"]
    assert load_launch(path, live).options["second"].camera.kind == "v4l2"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("settings", "change", "says"),
    [
        (["eye.log="], ("", ""), "give it with --set eye.log="),
        (["eyes.log=x"], ("", ""), "no node is called 'eyes'; did you mean `eye`?"),
        (["eye"], ("", ""), "--set eye: write NAME=VALUE"),
        (["eye.rate=fast"], ("", ""), "`rate`: must be a number, not a text"),
        (["eye.kind=v4l2", "eye.config=a.toml", "eye.config.fps=3"], ("", ""), "`config` is a value, not a table"),
        (["restart=on-failure", "eye.mode=fast"], ("", ""), "'eye' is to be restarted, but camera 'eye' waits"),
        (["restart=always"], ("", ""), "'always' is not valid"),
        ([], ('input = "eye"', 'input = "eyes"'), "did you mean `eye`?"),
        ([], ('input = "eye"', 'imput = "eye"'), "did you mean `input`?"),
        ([], ('mode = "realtime"', 'max_frames = "3"'), "`max_frames`: must be a whole number, not a text"),
        ([], ('out = "{out}/map"', ""), "node 'brain': the key `out` is missing"),
        ([], ('name = "brain"', 'name = "launch"'), "the launcher's own"),
        ([], ("[[node]]", "heartbeat_s = 0.2\n[[node]]"), "heartbeat_s"),
        ([], ("[[node]]", "x = " + "[" * 20000 + "\n[[node]]"), "not valid TOML"),
        ([], ('mode = "realtime"', "ack_timeout_s = nan"), "options.ack_timeout_s = nan"),
        (["eye.rate=" + "9" * 4094], ("", ""), "rate = a number of"),
        (["eye.log=a\udcff"], ("", ""), "log holds a NUL character or is not UTF-8"),
        ([], ('out = "{out}/map"', 'out = "a\\u0000"'), "out holds a NUL character"),
        ([], ("[[node]]", '[[node]]\nname = "n"\nkind = "camera"\n' * 64 + "[[node]]"), "length <= 64"),
    ],
)
def test_mistakes_are_named_with_the_fix(
    tmp_path: Path, settings: list[str], change: tuple[str, str], says: str
) -> None:
    path = file_of(tmp_path, SMALL.replace(*change, 1) if change[0] else SMALL)
    with pytest.raises(ConfigError) as caught:
        load_launch(path, ["eye.log=x", *settings])
    assert says in str(caught.value) and len(str(caught.value)) < 1500


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ('kind = ""', "which kind of camera; there are v4l2"),
        ('kind = "opencv"', "Give --set eye.poses.kind=KIND"),
        ('kind = "opencw", poses = { kind = "fixed" }', "`camera.kind`: no kind of camera is called 'opencw'; did you"),
        ('kind = "opencv", poses = { kind = "fixt" }', "'fixt' is no source of poses; did you mean `fixed`?"),
        ('kind = "opencv", poses = { kind = "device" }', "do not track themselves, and no frame would have a pose"),
    ],
)
def test_mistakes_in_a_camera_and_its_poses_are_found_before_a_start(tmp_path: Path, camera: str, says: str) -> None:
    text = SMALL.replace('log = ""\nmode = "realtime"', f"camera = {{ {camera} }}")
    with pytest.raises(ConfigError) as caught:
        load_launch(file_of(tmp_path, text))
    assert says in str(caught.value) and "launch.toml: node 'eye'" in str(caught.value)


def test_kinds_of_cameras_and_poses_are_those_of_the_drivers() -> None:
    assert semantic_mapper.drivers.registry.KINDS == CAMERA_KINDS
    assert tuple(semantic_mapper.drivers.poses.config.KINDS) == POSE_KINDS


def test_files_that_are_there_come_before_those_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "replay").mkdir()  # a folder of that name is no launch file
    assert find_launch(Path("replay")) == find_launch(Path("replay.toml")) == launch_files()["replay"]
    (tmp_path / "replay.toml").touch()
    assert find_launch(Path("replay.toml")) == Path("replay.toml")
    for name in ("replai", "elsewhere/replay", "../replay"):
        with pytest.raises(ConfigError, match=r"no such file, and no launch file of the package; .*replay"):
            find_launch(Path(name))
    with pytest.raises(ConfigError, match="no node of kind 'camera'"):
        load_launch(file_of(tmp_path, "node = []"))
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(ConfigError, match="is no regular file"):
        load_launch(tmp_path / "fifo")
