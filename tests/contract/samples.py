"""Messages of every kind, small, as values: what ``record`` encodes. Tests read the golden bytes alone."""

import hashlib
from typing import Any

import numpy as np

from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.changes import BlockChanges
from semantic_mapper.mapping.map_types import CameraPose, MapPoints
from semantic_mapper.queries.find import FoundObject
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
from semantic_mapper.queries.objects import MapObject, ObjectPlace
from semantic_mapper.queries.occupancy import DistanceField
from semantic_mapper.queries.questions import Correction, MapInfo, MapState, RememberedObjects, Weights, WeightsEntry
from semantic_mapper.queries.revisit import SIGNATURE
from semantic_mapper.queries.surface import RayHits
from semantic_mapper.transport.messages import (
    EndOfStream,
    FrameRefused,
    LabelledKeyframe,
    Status,
    StreamInfo,
    WeightsInUse,
    WeightsUpdate,
)
from semantic_mapper.transport.pose_message import decode_pose, encode_pose
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

LENS = CameraIntrinsics(20.5, 21.0, 7.5, 5.5, 16, 12, (0.1, -0.05, 0.001, 0.002, 0.01))
LABELS = LabelSet("Küche 7", (1, 2, 9), ("wall", "Tür", "counter top"), ((9, 80, 200), (1, 2, 3), (255, 0, 127)), 0)


def frame(*, depth: bool = True, label: bool = True, exact_mm: bool = True) -> Any:
    """A frame whose pose has all its digits; depth as a sensor's whole millimetres, or not."""
    rng = np.random.default_rng(3)
    c, s = np.cos(0.3), np.sin(0.3)
    T = np.array(((c, -s, 0, 1.25), (s, c, 0, -0.1), (0, 0, 1, 1 / 3), (0, 0, 0, 1)))
    depth_m = rng.integers(0, 5000, (12, 16)).astype(np.uint16).astype(np.float32) / np.float32(1000)
    return PosedFrame(
        stamp_ns=10**18 + 7,
        seq=42,
        camera_id="front:left-1",
        rgb=rng.integers(0, 256, (12, 16, 3), np.uint8),
        depth_m=None if not depth else depth_m if exact_mm else depth_m + np.float32(0.00026),
        label=rng.choice(np.array((0, 1, 2, 9), np.uint8), (12, 16)) if label else None,
        intrinsics=LENS,
        T_world_camera=T,
        pose_source="odometry",
        pose_sigma=0.015,
    )


def map_update() -> Any:
    """A rendered view of the same size."""
    rng = np.random.default_rng(4)
    return MapUpdate(
        stamp_ns=10**18 + 7,
        seq=42,
        camera_id="front:left-1",
        fused=True,
        is_keyframe=False,
        source_seqs=(40, 41),
        label=rng.choice(np.array((0, 1, 2, 9), np.uint8), (12, 16)),
        confidence=rng.integers(0, 256, (12, 16)).astype(np.float32) / np.float32(255),
        depth_m=rng.random((12, 16), np.float32),
        blocks=120,
        blocks_touched=31,
        rays=96,
        samples=4,
        stage_ms={"encode": 1.5, "fuse": 3.25},
    )


def messages() -> dict[str, tuple[str, Any, dict[str, Any]]]:
    """Topic, value and options of packing, by name."""
    data = b"safetensors" * 9
    weights = WeightsUpdate("learner", 2, data, hashlib.sha256(data).hexdigest(), "cd" * 32, 0.8, 0.5, 9, 3)
    cameras = {"front:left-1": LENS}
    return {
        "info": ("info", StreamInfo("folder Küche", cameras, LABELS, 200, 6.5, {"place": "lab"}), {}),
        "info_live": ("info", StreamInfo("a camera"), {}),
        "frame": ("frame", frame(), {}),
        "frame_without_depth": ("frame", frame(depth=False), {}),
        "frame_without_label": ("frame", frame(label=False), {}),
        "frame_without_both": ("frame", frame(depth=False, label=False), {}),
        "frame_float_depth": ("frame", frame(exact_mm=False), {}),
        "frame_raw": ("frame", frame(), {"rgb": "raw"}),
        "frame_jpeg": ("frame", frame(), {"rgb": "jpeg"}),
        "end": ("end", EndOfStream("player", "error", 200, "disk gone", ("bytes 5 to 9",)), {}),
        "map": ("map", map_update(), {}),
        "refused": ("refused", FrameRefused(4, 5, "front", "pose holds NaN"), {}),
        "status": ("status", Status("mapper", "degraded", 5, {"fused": 7}, {"frame": 0.25}, ("no GPU",)), {}),
        "keyframe": ("keyframe", LabelledKeyframe(frame(), LABELS, "a person"), {}),
        "weights": ("weights", weights, {}),
        "in_use": ("in_use", WeightsInUse("mapper", 1, "ab" * 32, 2, 2, False, "contradicts", True), {}),
    }


def questions() -> dict[str, dict[str, Any]]:
    """Fields by kind."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(5, 3))
    who = {"asker": "robot", "waits_s": 2.5}
    box = {"lower": (-1.0, -2.0, 0.0), "upper": (1.5, 2.0, 2.25)}
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = points[:2]
    return {
        "info": who,
        "at": {**who, "radius_m": 0.1, "points": points},
        "nearest": {**who, "class_name": "wall", "point": (0.0, 0.5, 1.0), "min_confidence": 0.25},
        "cast_rays": {**who, "max_m": 7.5, "origins": points, "directions": points[::-1].copy()},
        "points_in_box": {**who, **box},
        "instances": {**who, "up": (0.0, 0.0, 1.0)},
        "objects": {**who, "up": (0.0, 0.0, 1.0)},
        "find": {**who, "phrase": "cabinet", "limit": 3, "up": (0.0, 0.0, 1.0)},
        "occupancy": {**who, "points": points},
        "pose": who,
        "distance_field": {**who, **box, "unknown_is_occupied": True},
        "changes": {**who, "since": 3, "limit": 500, "map_id": "another map"},
        "correct_poses": {
            **who,
            "id": "x1",
            "cameras": ("rooms",),
            "until_ns": 10**9,
            "within_ns": 5_000_000,
            "stamps_ns": np.array((66_666_667, 200_000_001)),
            "camera": np.zeros(2, np.uint8),
            "poses": poses,
        },
        "correction": who,
        "weights": who,
    }


STATE = MapState("m1", 7, 1)


def answers() -> dict[str, Any]:
    """By kind."""
    rng = np.random.default_rng(6)
    u8, f4 = rng.integers(0, 255, 3).astype(np.uint8), rng.random(3).astype(np.float32)
    rgb, xyz = rng.integers(0, 255, (3, 3)).astype(np.uint8), rng.random((3, 3)).astype(np.float32)
    measured = np.array((True, False, True))
    correction = Correction(
        running=True,
        done=3,
        total=9,
        disk_bytes=10,
        completed=1,
        poses=4,
        frozen=5,
        lost=6,
        failure="no room",
        used=2,
        left_out=1,
        epoch=2,
    )
    entry = WeightsEntry(1, "ab" * 32, "in use", 0.7, 0.5, 9)
    center, size = rng.random((2, 3))
    box = OrientedBox(center, size, rng.random((3, 3)))
    voxels = np.array([[1, 2, 3], [4, 5, -6]], np.int32)
    thing = Instance(4, 9, "counter top", 0.75, rng.random(3), box, voxels)
    place = ObjectPlace(3, box, 2)
    looks = rgb[0], np.arange(SIGNATURE).astype(np.int8), np.array([[5, -6, 700]], np.int16)
    remembered = MapObject(4, 9, "counter top", ((9, 0.75),), box, *looks, 3, 8, 2, 2, (place,), certainty=0.5)
    changes = BlockChanges(
        since=3,
        version=7,
        newest=9,
        epoch=1,
        keys=np.array([[-1, 0, 3]], np.int32),
        tsdf=np.arange(512, dtype=np.int64).astype(np.int8)[None],
        label=np.full((1, 512), 9, np.uint8),
        confidence=np.full((1, 512), 200, np.uint8),
        rgb=np.arange(1536).astype(np.uint8).reshape(1, 512, 3),
    )
    far = np.array((1.5, np.inf, 0.25), np.float32)
    return {
        "info": MapInfo("m1", 7, 1, 9, 0.05, 4.0, LABELS),
        "at": PointAnswers(u8, f4, f4[::-1], u8 % 3, measured),
        "nearest": NearestSurface(np.array((0.1, 0.2, 1 / 3)), 0.5, 0.75),
        "cast_rays": RayHits(far, u8, f4, rgb, measured),
        "points_in_box": MapPoints(xyz, rgb, u8, f4, measured),
        "instances": (thing,),
        "objects": RememberedObjects((remembered,), 5),
        "find": (FoundObject(remembered, 0.5, {"class": 0.75}, "kitchen", np.eye(4)),),
        "occupancy": u8 % 3,
        "pose": CameraPose("rooms", 7, np.eye(4)),
        "distance_field": DistanceField(np.array((0.0, 0.1, 0.2)), 0.05, f4.reshape(1, 1, 3), u8.reshape(1, 1, 3) % 3),
        "changes": changes,
        "correct_poses": correction,
        "correction": correction,
        "weights": Weights(1, 1, 2, (entry,)),
    }


def pose_messages() -> dict[str, list[bytes]]:
    """A robot's own pose as programs send it: msgpack with topic, and JSON without."""
    json = b'{"v": 1, "stamp_ns": 12, "position": [1, 2, 0.5], "quaternion": [0, 0, 0.6, 0.8]}'
    text = b'{"v": 1, "stamp_ns": 12, "position": [1, 2, 0.5], "quaternion": [0, 0, 0.6, 0.8], "sigma": 0.02, '
    text += b'"parent": "odom", "child": "base"}'
    packed = encode_pose(decode_pose([text]))
    return {"msgpack": packed, "json": [json], "json_with_topic": [b"pose", text]}
