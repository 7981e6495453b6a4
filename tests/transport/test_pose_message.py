from __future__ import annotations

import math

import msgpack
import pytest

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.pose_message import decode_pose

PLAIN = {"v": 1, "stamp_ns": 5, "position": [1.0, 2.0, 3.0], "quaternion": [0.0, 0.0, 0.0, 1.0]}


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


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([b"{" + b" " * 2048], "2049 bytes"),
        ([b""], "0 bytes"),
        ([b"a", b"b", b"c"], "3 parts"),
        ([b"[" * 2000], ""),
        ([b'{"a":' * 400], "not JSON"),
    ],
)
def test_sizes_are_bounded_before_anything_is_parsed(parts: list[bytes], reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        decode_pose(parts)
