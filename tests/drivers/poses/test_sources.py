from __future__ import annotations

import math
import tomllib
from typing import Any

import pytest

from semantic_mapper.drivers.poses.board import BoardPoseSource
from semantic_mapper.drivers.poses.config import IDENTITY
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.drivers.poses.sources import DevicePoseSource, FixedPoseSource, make_poses, read_pose_config
from semantic_mapper.drivers.poses.topic import TopicPoseSource
from semantic_mapper.drivers.poses.visual import VisualPoseSource
from semantic_mapper.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ('kind = "device"', DevicePoseSource),
        ('kind = "fixed"\nT_world_camera = [[1,0,0,2],[0,1,0,0],[0,0,1,0],[0,0,0,1]]', FixedPoseSource),
        ('kind = "topic"\nendpoint = "ipc:///tmp/robot"', TopicPoseSource),
        ('kind = "board"\ncolumns = 5', BoardPoseSource),
        ('kind = "rgbd"\nloop_closure = false', OdometryPoseSource),
        ('kind = "visual"\ncamera_height_m = 1.0', VisualPoseSource),
        ('kind = "visual"\nscale = { kind = "board", columns = 5 }', VisualPoseSource),
    ],
)
def test_a_section_of_a_launch_file_becomes_a_pose_source(text: str, kind: type) -> None:
    source = make_poses(read_pose_config(tomllib.loads(text)))
    assert isinstance(source, kind)
    assert source.warnings == () and not source.counters


NO_ROTATION = [[2.0, 0, 0, 0], *IDENTITY[1:]]
NO_NUMBER = [[math.nan, 0, 0, 0], *IDENTITY[1:]]


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        ({}, "no kind of poses is called None; there are device, fixed, topic, board, rgbd, visual"),
        ({"kind": "bord"}, "did you mean `board`"),
        ({"kind": "topic"}, "endpoint"),
        ({"kind": "board", "column": 3}, "did you mean `columns`"),
        ({"kind": "board", "square_m": 0.02}, "must be smaller than square_m"),
        ({"kind": "board", "rows": 1}, "at least 2 columns"),
        ({"kind": "board", "T_world_board": NO_ROTATION}, "poses: T_world_board"),
        ({"kind": "fixed", "T_world_camera": [[1, 0], [0, 1]]}, "T_world_camera"),
        ({"kind": "fixed", "T_world_camera": NO_NUMBER}, "poses: T_world_camera"),
        ({"kind": "topic", "endpoint": "ipc:///tmp/x", "T_base_camera": NO_ROTATION}, "poses: T_base_camera"),
        ({"kind": "rgbd", "loop_closure": 1.5}, "loop_closure"),
        ({"kind": "rgbd", "T_world_start": NO_NUMBER}, "poses: T_world_start"),
        ({"kind": "visual", "scale": {"kind": "fixed"}}, 'must be "topic" or "board"'),
        ({"kind": "visual", "scale": {"kind": "board", "colums": 5}}, "did you mean `columns`"),
        ({"kind": "visual", "scale": {"kind": "board"}, "distance_m": 2.0}, "one of scale, distance_m and camera_hei"),
    ],
)
def test_what_is_wrong_is_named(config: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        read_pose_config(config, "launch.toml: poses")
