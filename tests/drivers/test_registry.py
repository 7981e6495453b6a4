"""Kinds of cameras by name; one that cannot be loaded hurts no other."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest

from semantic_mapper.drivers.registry import FoundCamera, find_cameras, load_driver, open_camera
from semantic_mapper.errors import CameraError, ConfigError, DependencyError


@pytest.mark.parametrize(
    ("kind", "says"), [("v4l", "did you mean 'v4l2'?"), ("ros", "there are v4l2, opencv, stereo, oak, realsense")]
)
def test_an_unknown_kind_is_told_with_those_that_there_are(kind: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_driver(kind)
    assert says in str(caught.value)


def test_a_kind_whose_packages_are_missing_says_so_and_the_others_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        sys.modules, "semantic_mapper.drivers.oak", None
    )  # what an import of it then raises is an ImportError
    with pytest.raises(DependencyError, match="kind 'oak' cannot be used here"):
        load_driver("oak")
    found, unknown = find_cameras(("oak", "opencv"))
    assert found == [] and list(unknown) == ["oak"]


def test_a_kind_that_cannot_search_is_told_and_the_others_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    broken, whole = ModuleType("semantic_mapper.drivers.oak"), ModuleType("semantic_mapper.drivers.v4l2")

    def cannot() -> list[FoundCamera]:
        raise CameraError("the bus is gone")

    camera = FoundCamera("v4l2", "HD Webcam", "/dev/video0")
    vars(broken)["list_devices"] = cannot
    vars(whole)["list_devices"] = lambda: [camera]
    monkeypatch.setitem(sys.modules, "semantic_mapper.drivers.oak", broken)
    monkeypatch.setitem(sys.modules, "semantic_mapper.drivers.v4l2", whole)
    assert find_cameras(("oak", "v4l2")) == ([camera], {"oak": "the bus is gone"})


def test_a_camera_is_made_of_plain_settings_that_are_checked() -> None:
    camera = open_camera("opencv", {"source": "film.mp4", "uncalibrated": True}, "film", "launch.toml")
    assert camera.warnings == ("not calibrated: the intrinsics are a guess, good for calibrating only",)
    with pytest.raises(ConfigError, match=r"launch.toml: .*did you mean `source`"):
        open_camera("opencv", {"sourc": "film.mp4"}, "film", "launch.toml")
