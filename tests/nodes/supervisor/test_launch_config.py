"""Launch files: what is accepted, what is refused, and how the refusal helps."""

from __future__ import annotations

import dataclasses
import os
import re
from datetime import datetime, tzinfo
from pathlib import Path

import numpy as np
import pytest

import semantic_mapper.drivers.poses.config
import semantic_mapper.drivers.registry
from semantic_mapper.config import load_config
from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.errors import ConfigError, TransportError
from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.camera.live import make_source
from semantic_mapper.nodes.options import CAMERA_KINDS, POSE_KINDS, CameraOptions, MapperOptions, RecorderOptions
from semantic_mapper.nodes.supervisor import launch_config
from semantic_mapper.nodes.supervisor.launch_config import LaunchFile, load_launch
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.endpoints import check_bind
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics
from tests.nodes.support import REPLAY_LAUNCH, write_log
from tests.small import INTRINSICS, tiny_frames

SMALL = """
[set]
log = ""
rate = 1.0
[[node]]
name = "eye"
kind = "camera"
[node.options]
log = "{log}"
mode = "realtime"
rate = "{rate}"
[[node]]
name = "brain"
kind = "mapper"
[node.options]
input = "eye"
out = "results/{log}.d"
"""


def _file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "launch.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "path", [REPLAY_LAUNCH, *map(REPLAY_LAUNCH.with_name, ("record.toml", "replay-live.toml"))], ids=lambda p: p.name
)
def test_launch_files_for_logs_are_valid(path: Path) -> None:
    launch = load_launch(path, ["log=room.mcap"], Path("somewhere"))
    camera, mapper = launch.options["camera"], launch.options["mapper"]
    as_live = path.name == "replay-live.toml"
    assert isinstance(camera, CameraOptions) and camera.log == "room.mcap"
    assert camera.mode == ("realtime" if as_live else "lockstep")
    assert isinstance(mapper, MapperOptions) and mapper.out == "somewhere"
    assert mapper.delivery == ("newest" if as_live else "all")
    recorders = [o for o in launch.options.values() if isinstance(o, RecorderOptions)]
    assert launch.listeners("camera") == 1 + len(recorders)


def test_the_launch_file_for_several_cameras_fits_drivers_poses_and_calibrations(tmp_path: Path) -> None:
    T = np.eye(4)
    T[0, 3] = 0.12
    lens = CameraIntrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)
    for name in ("left", "right"):
        save_calibration(tmp_path / f"{name}.toml", lens, T, {})
    settings = ["left=/dev/video0", "right=/dev/video2", f"calibration={tmp_path}"]
    launch = load_launch(REPLAY_LAUNCH.with_name("multi-camera.toml"), settings, Path("somewhere"))
    mapper, recorder = launch.options["mapper"], launch.options["recorder"]
    assert isinstance(mapper, MapperOptions) and mapper.cameras == mapper.inputs() == ("left", "right")
    assert isinstance(recorder, RecorderOptions) and recorder.cameras == ("left", "right")
    assert launch.listeners("left") == launch.listeners("right") == 2
    for name in ("left", "right"):
        options = launch.options[name]
        assert isinstance(options, CameraOptions) and options.camera is not None and options.camera.id == name
        source = make_source(options.camera)  # not open yet
        np.testing.assert_array_equal(source._T_rig_camera, T)  # type: ignore[attr-defined]


def test_the_launch_file_for_a_robot_publishes_on_loopback_and_restarts_what_it_can() -> None:
    launch = load_launch(REPLAY_LAUNCH.with_name("headless-onboard.toml"), ["keys=k", "status=tcp://127.0.0.1:7"])
    mapper = launch.options["mapper"]
    assert (launch.publish, launch.keys) == ("tcp://127.0.0.1:7", "k")
    assert isinstance(mapper, MapperOptions) and mapper.save_every_s > 0 and mapper.keys == "k"
    assert mapper.query.startswith("tcp://127.0.0.1:") and mapper.publish.startswith("tcp://127.0.0.1:")
    assert {node.name for node in launch.nodes if node.restart == "on-failure"} == {"camera", "mapper", "recorder"}
    assert launch.sockets() == ("launch", "mapper", "camera", "recorder")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            ('id = "right"', 'id = "left"'),
            "two cameras of node 'mapper', 'left' and 'right', have the id 'left'; give each its own `id`",
        ),
        (('input = ["left", "right"]', 'input = ["left", "rihgt"]'), "did you mean 'right'?"),
        (('input = ["left", "right"]', 'input = ["left", "recorder"]'), "'recorder', which is no camera"),
        (("streams = 2", "streams = 4"), "there are 3 sources"),
        (('input = ["left", "right"]', "input = []"), "input"),
        (("streams = 2", "streams = 3"), "'mapper', which is no camera"),
    ],
)
def test_mistakes_with_several_cameras_are_named(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    text = REPLAY_LAUNCH.with_name("multi-camera.toml").read_text(encoding="utf-8")
    assert change[0] in text
    with pytest.raises(ConfigError) as caught:
        load_launch(_file(tmp_path, text.replace(*change)), ["left=/dev/video0", "right=/dev/video2"])
    assert says in str(caught.value)


TWO_LOGS = """
[[node]]
name = "left"
kind = "camera"
[node.options]
log = "{left}"
mode = "realtime"
[[node]]
name = "right"
kind = "camera"
[node.options]
log = "{right}"
mode = "realtime"
[[node]]
name = "mapper"
kind = "mapper"
[node.options]
input = ["left", "right"]
out = "somewhere"
"""


def test_two_logs_of_one_camera_are_refused_with_the_ways_out(tmp_path: Path) -> None:
    frames = tiny_frames(2)
    one, other = write_log(tmp_path / "one.mcap", frames), write_log(tmp_path / "other.mcap", frames)
    path = _file(tmp_path, TWO_LOGS.format(left=one, right=other))
    with pytest.raises(ConfigError, match=r"'left' and 'right', have the id 'rooms'; frames of a log keep.*own"):
        load_launch(path)
    second = [dataclasses.replace(frame, camera_id="second") for frame in frames]
    info = StreamInfo(source="test room", cameras={"second": INTRINSICS}, label_set=ROOMS, frame_count=2)
    with LogWriter(tmp_path / "second.mcap", info) as log:
        for frame in second:
            log.write_frame(frame)
    assert load_launch(_file(tmp_path, TWO_LOGS.format(left=one, right=tmp_path / "second.mcap")))
    live = TWO_LOGS.format(left=one, right="").replace(
        'log = ""\nmode = "realtime"', 'camera = { kind = "v4l2", id = "rooms", poses = { kind = "fixed" } }'
    )
    with pytest.raises(ConfigError, match="have the id 'rooms'; frames of a log"):
        load_launch(_file(tmp_path, live))
    assert load_launch(_file(tmp_path, live.replace('id = "rooms"', 'id = "other"')))
    gone = load_launch(_file(tmp_path, TWO_LOGS.format(left=one, right=tmp_path / "none.mcap")))
    assert gone.inputs("mapper") == ("left", "right"), "that it is not there is said by the node"


def test_the_map_of_the_remote_viewer_is_answered_for_with_keys() -> None:
    given = ["keys=k", "kind=v4l2", "camera=webcam.toml", "poses=poses.toml"]
    launch = load_launch(REPLAY_LAUNCH.with_name("remote-viewer.toml"), given, Path("somewhere"))
    camera, mapper = launch.options["camera"], launch.options["mapper"]
    assert isinstance(camera, CameraOptions) and camera.camera is not None
    assert (camera.camera.kind, camera.camera.config, camera.camera.poses) == ("v4l2", "webcam.toml", "poses.toml")
    assert isinstance(mapper, MapperOptions) and (mapper.query, mapper.keys) == ("tcp://0.0.0.0:5570", "k")
    assert "query" not in launch.sockets(), "nowhere else"
    with pytest.raises(TransportError, match="which needs keys"):
        check_bind(mapper.query)


@pytest.mark.parametrize("kind", ["foxglove", "zenoh"])
def test_a_bridge_is_one_more_listener_and_asks_the_mapper(tmp_path: Path, kind: str) -> None:
    path = REPLAY_LAUNCH.with_name(f"{kind}.toml")
    given = ["kind=v4l2", "camera=webcam.toml", "poses=poses.toml"]
    launch = load_launch(path, given, Path("somewhere"))
    assert launch.inputs(kind) == ("camera", "mapper") and launch.listeners("camera") == 2
    again = load_launch(
        path, [*given, "map=runs/yesterday", "history=7", "corrections=query"], Path("somewhere")
    ).options
    camera, mapper = again["camera"], again["mapper"]
    assert isinstance(mapper, MapperOptions) and (mapper.map, mapper.history_frames) == ("runs/yesterday", 7)
    assert isinstance(camera, CameraOptions) and camera.corrections == mapper.query
    text = path.read_text(encoding="utf-8")
    bridge = f'kind = "{kind}"\nrestart = "on-failure"\n[node.options]\n'
    for change, says in (
        ('mapper = "camera"\n', f"node '{kind}' shows the map of 'camera', which is no mapper"),
        ('query = "ask"\n', f"node '{kind}' asks about the map at 'ask', but mapper 'mapper' answers at 'query'"),
        ('keys = "k"\n', f"node '{kind}' has the keys 'k', but mapper 'mapper' ''; give both the same"),
        ('mapper = "maper"\n', "did you mean 'mapper'?"),
        ("refresh_s = 0.0\n", "refresh_s"),
    ):
        assert bridge in text
        other = text.replace(bridge, bridge + change).replace('refresh_s = "{refresh}"\n', "")
        with pytest.raises(ConfigError, match=re.escape(says)):
            load_launch(_file(tmp_path, other), given)


def test_addresses_of_zenoh_are_checked_before_anything_starts() -> None:
    given = ["kind=v4l2", "camera=webcam.toml", "poses=poses.toml"]
    for listen, says in (
        ("tcp/0.0.0.0:7447", "node 'zenoh': .* certificates"),
        ("tcp/127.0.0.1:99999", "ports end at"),
    ):
        with pytest.raises((ConfigError, TransportError), match=says):
            load_launch(REPLAY_LAUNCH.with_name("zenoh.toml"), [*given, f"listen={listen}"])


def test_launch_files_for_cameras_are_as_the_docs_say() -> None:
    live = 0
    for path in set(REPLAY_LAUNCH.parent.glob("*.toml")) - {REPLAY_LAUNCH.with_name("video.toml")}:  # a film waits
        file = load_config(path, LaunchFile)
        if not any(node.kind == "camera" and "camera" in node.options for node in file.node):
            continue
        live += 1
        assert file.heartbeat_s == 1.5, path.name
        assert "{now}" in str(file.set["out"]), path.name
        for node in file.node:
            assert not node.standby, f"{path.name}: {node.name}"
    assert live == 11


def test_settings_are_filled_in_with_their_own_type(tmp_path: Path) -> None:
    launch = load_launch(_file(tmp_path, SMALL), ["log=kitchen", "rate=2.5"])
    camera, mapper = launch.options["eye"], launch.options["brain"]
    assert isinstance(camera, CameraOptions) and camera.rate == 2.5
    assert isinstance(mapper, MapperOptions) and mapper.out == "results/kitchen.d"
    assert launch.inputs("brain") == ("eye",)


def test_a_text_stays_a_text_whatever_it_looks_like(tmp_path: Path) -> None:
    looks = {"1844301078": "1844301078", "123E45": "123E45", "true": "true", '"a b"': "a b"}
    for given, kept in looks.items():
        launch = load_launch(_file(tmp_path, SMALL), [f"log={given}", "rate=2"])
        camera = launch.options["eye"]
        assert isinstance(camera, CameraOptions) and (camera.log, camera.rate) == (kept, 2.0)
    oak = load_launch(REPLAY_LAUNCH.with_name("oak.toml"), ["device=1844301078", "fps=15"]).options["camera"]
    assert isinstance(oak, CameraOptions) and oak.camera is not None
    assert oak.camera.config == {"device": "1844301078", "fps": 15, "odometry": True}


def test_each_start_has_a_name_of_its_own_even_where_the_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:
            return datetime(2026, 11, 23, 2, 47, tzinfo=tz)

    monkeypatch.setattr(launch_config, "datetime", Clock)
    text = SMALL.replace("results/{log}.d", "{out}/map").replace("[set]", f'[set]\nout = "{tmp_path}/{{now}}"')
    for name in ("20261123T024700Z", "20261123T024700Z-1", "20261123T024700Z-2"):
        mapper = load_launch(_file(tmp_path, text), ["log=x"]).options["brain"]
        assert isinstance(mapper, MapperOptions) and mapper.out == f"{tmp_path}/{name}/map"
        (tmp_path / name).mkdir()
    mapper = load_launch(_file(tmp_path, text), ["log=x", "now=today"]).options["brain"]
    assert isinstance(mapper, MapperOptions) and mapper.out == f"{tmp_path}/today/map"


def test_file_name_with_spaces_and_equals_sign_is_kept(tmp_path: Path) -> None:
    launch = load_launch(_file(tmp_path, SMALL), ["log=/data/a = b.mcap"])
    camera = launch.options["eye"]
    assert isinstance(camera, CameraOptions) and camera.log == "/data/a = b.mcap"


@pytest.mark.parametrize(
    ("settings", "change", "says"),
    [
        ([], ("", ""), "give it with --set log="),
        (["lok=x"], ("", ""), "did you mean 'log'?"),
        (["log"], ("", ""), "write NAME=VALUE"),
        (["log=x", "rate=-1"], ("", ""), "rate"),
        (["log=x", "rate=fast"], ("", ""), "rate"),
        (["log=x"], ('input = "eye"', 'input = "eyes"'), "did you mean 'eye'?"),
        (["log=x"], ('input = "eye"', 'imput = "eye"'), "did you mean `input`?"),
        (
            ["log=x"],
            ('kind = "mapper"', 'kind = "maper"'),
            "`node[1].kind`: 'maper' is not valid; did you mean `mapper`?",
        ),
        (["log=x"], ('mode = "realtime"', 'mode = "real"'), "node 'eye': `mode`: 'real' is not valid; did you mean"),
        (["log=x"], ('mode = "realtime"', 'max_frames = "3"'), "`max_frames`: must be a whole number, not a text"),
        (["log=x"], ("[node.options]", "[node.option]"), "`node[0]`: unknown key `option`; did you mean `options`?"),
        (["log=x"], ('out = "results/{log}.d"', ""), "node 'brain': the key `out` is missing"),
        (["log=x"], ('name = "brain"', 'name = "eye"'), "unique"),
        (["log=x"], ('name = "brain"', 'name = "../brain"'), "letters"),
        (["log=x"], ("{rate}", "{rat}"), "did you mean 'rate'?"),
        (["log=x"], ("[set]", "[sett]"), "did you mean `set`?"),
        (["log=x"], ("[set]", "[set"), "not valid TOML"),
    ],
)
def test_mistakes_are_named_with_the_mend(
    tmp_path: Path, settings: list[str], change: tuple[str, str], says: str
) -> None:
    path = _file(tmp_path, SMALL.replace(*change) if change[0] else SMALL)
    with pytest.raises(ConfigError) as caught:
        load_launch(path, settings)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ('kind = "opencv"', 'poses = { kind = "topic", endpoint = "tcp://127.0.0.1:5560" }'),
        ('kind = "opencw", poses = { kind = "fixed" }', "`camera.kind`: no kind of camera is called 'opencw'; did you"),
        ('kind = "opencv", poses = { kind = "fixt" }', "'fixt' is no source of poses; did you mean 'fixed'?"),
        ('kind = "opencv", poses = { kind = "device" }', "do not track themselves, and no frame would have a pose"),
        ('kind = "opencv", poses = "fixed"', 'poses = { kind = "fixed" }'),
        ('kind = "opencv", poses = {}', "`camera.poses` is empty"),
        ('kind = "v4l2", poses = { T_world_camera = [] }', "there are device, fixed, topic, board, rgbd"),
    ],
)
def test_mistakes_in_a_camera_and_its_poses_are_found_before_anything_starts(
    tmp_path: Path, camera: str, says: str
) -> None:
    text = SMALL.replace('log = "{log}"\nmode = "realtime"\nrate = "{rate}"', f"camera = {{ {camera} }}")
    with pytest.raises(ConfigError) as caught:
        load_launch(_file(tmp_path, text), ["log=x"])
    assert says in str(caught.value) and "launch.toml: node 'eye'" in str(caught.value)


def test_kinds_of_cameras_and_poses_are_those_of_the_drivers() -> None:
    assert (semantic_mapper.drivers.registry.KINDS, tuple(semantic_mapper.drivers.poses.config.KINDS)) == (
        CAMERA_KINDS,
        POSE_KINDS,
    )


def test_launch_without_a_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no node of kind 'camera'"):
        load_launch(_file(tmp_path, "node = []"))


@pytest.mark.parametrize(
    ("settings", "change", "says"),
    [
        (["log=x"], ("[[node]]", "stop_s = 1e308\n[[node]]"), "stop_s = 1e+308: give a number between"),
        (["log=x"], ("[[node]]", "heartbeat_s = inf\n[[node]]"), "heartbeat_s = inf"),
        (["log=x"], ("[[node]]", "heartbeat_s = 1e7\n[[node]]"), "heartbeat_s = 1e+07"),
        (["log=x"], ("[[node]]", "heartbeat_s = " + "9" * 5000 + "\n[[node]]"), "not valid TOML"),
        (["log=x"], ("[[node]]", "x = " + "[" * 20000 + "\n[[node]]"), "not valid TOML"),
        (["log=x"], ('mode = "realtime"', "subscriber_timeout_s = nan"), "options.subscriber_timeout_s = nan"),
        (["log=x", "rate=inf"], ("", ""), "rate = inf"),
        (["log=x", "rate=1e-300"], ("", ""), "rate"),
        (["log=x", "rate=1e308"], ("", ""), "rate"),
        (["log=x", "rate=" + "9" * 4094], ("", ""), "rate = a number of"),
        (["log=x", "rate=" + "9" * 5000], ("", ""), "longer than 4096 letters"),
        (["log=x", "rate=" + "[" * 4000], ("", ""), "rate"),
        (["log=" + "x" * 5000], ("", ""), "longer than 4096 letters"),
        (["log=a\udcff"], ("", ""), "log is not UTF-8"),
        (["log=x"], ("{log}", "a\\u0000"), "log holds a NUL character"),
        (["log=" + "x" * 4000], ("results/{log}.d", "{log}{log}"), "longer than 4096 letters"),
        (["log=x"], ("[[node]]", '[[node]]\nname = "n"\nkind = "camera"\n' * 64 + "[[node]]"), "length <= 64"),
    ],
)
def test_hostile_values_are_refused_by_name(
    tmp_path: Path, settings: list[str], change: tuple[str, str], says: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load_launch(_file(tmp_path, SMALL.replace(change[0], change[1], 1) if change[0] else SMALL), settings)
    assert says in str(caught.value) and len(str(caught.value)) < 1500


def test_a_launch_file_without_an_end_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (Path("/dev/zero"), tmp_path / "fifo"):
        with pytest.raises(ConfigError, match="is no regular file"):
            load_launch(path)
