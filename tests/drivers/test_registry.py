"""Kinds of cameras by name; one that cannot be loaded hurts no other."""

import sys
from types import ModuleType

import pytest

from semantic_mapper.drivers.registry import FoundCamera, find_cameras, load_driver
from semantic_mapper.errors import CameraError, ConfigError, DependencyError


@pytest.mark.parametrize(
    ("kind", "says"), [("v4l", "did you mean `v4l2`?"), ("ros", "there are v4l2, opencv, stereo, oak, realsense")]
)
def test_an_unknown_kind_is_told_with_those_that_there_are(kind: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_driver(kind)
    assert says in str(caught.value)


def test_a_kind_that_cannot_be_used_or_searched_for_says_so_and_the_others_are_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken, whole = (
        ModuleType("semantic_mapper.drivers.realsense.camera"),
        ModuleType("semantic_mapper.drivers.v4l2.camera"),
    )

    def cannot() -> list[FoundCamera]:
        raise CameraError("the bus is gone")

    camera = FoundCamera("v4l2", "HD Webcam", "/dev/video0")
    vars(broken)["list_devices"] = cannot
    vars(whole)["list_devices"] = lambda: [camera]
    for name, module in (("oak", None), ("realsense", broken), ("v4l2", whole)):  # None: its import fails
        monkeypatch.setitem(sys.modules, f"semantic_mapper.drivers.{name}.camera", module)
    with pytest.raises(DependencyError, match="kind 'oak' cannot be used here"):
        load_driver("oak")
    found, unknown = find_cameras(("oak", "realsense", "v4l2"))
    assert found == [camera] and list(unknown) == ["oak", "realsense"] and unknown["realsense"] == "the bus is gone"
