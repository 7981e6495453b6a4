"""Launch files: what is accepted, what is refused, and how the refusal helps."""

from __future__ import annotations

from pathlib import Path

import pytest

from nodes.launch_config import load_launch
from nodes.options import CameraOptions, MapperOptions, RecorderOptions
from semantic_mapper.errors import ConfigError
from tests.nodes.support import REPLAY_LAUNCH

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


@pytest.mark.parametrize("path", sorted(REPLAY_LAUNCH.parent.glob("*.toml")), ids=lambda p: p.name)
def test_shipped_launch_files_are_valid(path: Path) -> None:
    launch = load_launch(path, ["log=room.mcap"], Path("somewhere"))
    camera, mapper = launch.options["camera"], launch.options["mapper"]
    assert isinstance(camera, CameraOptions) and camera.log == "room.mcap" and camera.mode == "lockstep"
    assert isinstance(mapper, MapperOptions) and mapper.out == "somewhere" and mapper.delivery == "all"
    recorders = [o for o in launch.options.values() if isinstance(o, RecorderOptions)]
    assert launch.listeners("camera") == 1 + len(recorders)


def test_settings_are_filled_in_with_their_own_type(tmp_path: Path) -> None:
    launch = load_launch(_file(tmp_path, SMALL), ["log=kitchen", "rate=2.5"])
    camera, mapper = launch.options["eye"], launch.options["brain"]
    assert isinstance(camera, CameraOptions) and camera.rate == 2.5
    assert isinstance(mapper, MapperOptions) and mapper.out == "results/kitchen.d"
    assert launch.inputs("brain") == ("eye",)


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
        (["log=x"], ('kind = "mapper"', 'kind = "maper"'), "maper"),
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


def test_launch_without_a_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no node of kind 'camera'"):
        load_launch(_file(tmp_path, "node = []"))
