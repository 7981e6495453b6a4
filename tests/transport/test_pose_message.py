from __future__ import annotations

import json
import math

import msgpack
import numpy as np
import pytest

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.pose_message import PoseMessage, decode_pose, encode_pose

PLAIN = {"v": 1, "stamp_ns": 5, "position": [1.0, 2.0, 3.0], "quaternion": [0.0, 0.0, 0.0, 1.0]}


def turned() -> PoseMessage:
    half = math.radians(90) / 2
    return PoseMessage(
        stamp_ns=2**62,
        position=(1.0, 2.0, 3.0),
        quaternion=(0.0, 0.0, math.sin(half), math.cos(half)),
        sigma=0.02,
        parent="odom",
        child="base",
    )


def test_a_message_comes_back_as_it_was() -> None:
    assert decode_pose(encode_pose(turned(), "odom")) == turned()


def test_msgpack_and_json_with_and_without_a_topic_say_the_same() -> None:
    for payload in (msgpack.packb(PLAIN), json.dumps(PLAIN).encode(), b"\n " + json.dumps(PLAIN, indent=1).encode()):
        for parts in ([payload], [b"odom", payload]):
            message = decode_pose(parts)
            assert message.stamp_ns == 5 and message.position == (1, 2, 3) and message.sigma == 0


def test_the_matrix_takes_points_of_the_child_to_the_parent() -> None:
    T = turned().matrix
    assert np.allclose(T @ (1, 0, 0, 1), (1, 3, 3, 1))  # a quarter turn about z: x becomes y


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"v": 2}, "version"),
        ({"stamp_ns": -1}, "stamp_ns"),
        ({"stamp_ns": 1.5}, "stamp_ns"),
        ({"position": [1.0, 2.0]}, "position"),
        ({"position": [1.0, 2.0, math.nan]}, "finite"),
        ({"quaternion": [0.0, 0.0, 0.0, 0.5]}, "length 0.5"),
        ({"quaternion": [0.0, 0.0, 0.0, math.inf]}, "finite"),
        ({"sigma": -0.1}, "sigma"),
        ({"parent": "x" * 65}, "parent"),
        ({"frame": "odom"}, "frame"),
    ],
)
def test_a_bad_field_is_named(change: dict[str, object], reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        decode_pose([msgpack.packb({**PLAIN, **change})])


def test_sizes_are_bounded_before_anything_is_parsed() -> None:
    with pytest.raises(CodecError, match="2049 bytes"):
        decode_pose([b"{" + b" " * 2048])
    with pytest.raises(CodecError, match="0 bytes"):
        decode_pose([b""])
    with pytest.raises(CodecError, match="3 parts"):
        decode_pose([b"a", b"b", b"c"])
    with pytest.raises(CodecError):
        decode_pose([b"[" * 2000])
    with pytest.raises(CodecError, match="not JSON"):
        decode_pose([b'{"a":' * 400])
