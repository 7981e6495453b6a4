import math

import msgpack
import pytest

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.pose_message import decode_pose

PLAIN = {"v": 1, "stamp_ns": 5, "position": [1.0, 2.0, 3.0], "quaternion": [0.0, 0.0, 0.0, 1.0]}


FIELDS = {
    "version": {"v": 2},
    "stamp_ns": {"stamp_ns": 1.5},
    "position": {"position": [1.0, 2.0]},
    "finite": {"position": [1.0, 2.0, math.nan]},
    "length 0.5": {"quaternion": [0.0, 0.0, 0.0, 0.5]},
    "finite .*quaternion": {"quaternion": [0.0, 0.0, 0.0, math.inf]},
    "sigma": {"sigma": -0.1},
    "parent": {"parent": "x" * 65},
    "frame": {"frame": "odom"},
}


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        *(([msgpack.packb({**PLAIN, **change})], reason) for reason, change in FIELDS.items()),
        ([b"{" + b" " * 2048], "2049 bytes"),
        ([b""], "0 bytes"),
        ([b"a", b"b", b"c"], "3 parts"),
        ([b"[" * 2000], "bad header"),
        ([b'{"a":' * 400], "not JSON"),
    ],
)
def test_what_is_no_pose_is_refused_with_what_is_wrong(parts: list[bytes], reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        decode_pose(parts)
