"""The message by which a robot tells where it is: small, documented, msgpack or JSON, so that any program can send it.

One ZeroMQ message of one part, or of two: ``[topic, payload]``. The payload is a map, as msgpack or as JSON::

    {"v": 1, "stamp_ns": 123456789, "position": [x, y, z], "quaternion": [x, y, z, w],
     "sigma": 0.02, "parent": "odom", "child": "base"}

``stamp_ns`` is the moment of the pose, in nanoseconds on the clock that stamps the images (CLOCK_MONOTONIC of one
machine). Position, in metres, and quaternion are of frame ``child`` in frame ``parent``: ``p_parent = T @ p_child``.
``sigma`` is the position's one-sigma uncertainty in metres; 0 or left out: not known.
"""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.errors import CodecError
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.transport.codec import check_header, pack_header, to_plain, unpack_header
from semantic_mapper.transport.messages import CaptureStamp, Finite, Parts, Wire
from semantic_mapper.types import MAX_POSE_SIGMA_M, Float64

MAX_POSE_BYTES = 2048
QUATERNION_TOLERANCE = 1e-2  # of its length from 1: what is further off is no rounding error

_WHAT = "pose message"
FrameName = Annotated[str, Meta(max_length=64)]
Three = Annotated[tuple[Finite, ...], Meta(min_length=3, max_length=3)]
Four = Annotated[tuple[Finite, ...], Meta(min_length=4, max_length=4)]


class PoseMessage(Wire, frozen=True, kw_only=True):
    """Where frame ``child`` was in frame ``parent`` at ``stamp_ns``; fields as in the module's words."""

    stamp_ns: CaptureStamp
    position: Three
    quaternion: Four  # x y z w
    sigma: Annotated[float, Meta(ge=0, le=MAX_POSE_SIGMA_M)] = 0.0
    parent: FrameName = ""
    child: FrameName = ""

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.quaternion))
        if not abs(length - 1) <= QUATERNION_TOLERANCE:  # NaN, too
            raise CodecError(f"{_WHAT}: the quaternion [x, y, z, w] has length {length:.3g}, not 1: it is no rotation")

    @property
    def matrix(self) -> Float64:
        """``T_parent_child`` (4, 4) float64."""
        return pose_matrix(np.array(self.position, np.float64), np.array(self.quaternion, np.float64))


def encode_pose(message: PoseMessage, topic: str = "pose") -> list[bytes]:
    """Message -> [topic, msgpack]; ``CodecError`` where a value cannot be sent, such as NaN."""
    header = to_plain(message, _WHAT)
    check_header(header, PoseMessage, _WHAT)
    return [topic.encode(), pack_header(header, _WHAT)]


def decode_pose(parts: Parts) -> PoseMessage:
    """Inverse of ``encode_pose``; takes JSON, and a payload without topic, too. ``CodecError`` where it is no pose, or
    longer than ``MAX_POSE_BYTES``."""
    if not 1 <= len(parts) <= 2:
        raise CodecError(f"{_WHAT}: has one part, or topic and payload; got {len(parts)} parts")
    payload = bytes(parts[-1]) if len(parts[-1]) <= MAX_POSE_BYTES else b""
    if not payload:
        raise CodecError(f"{_WHAT}: of {len(parts[-1])} bytes; 1 to {MAX_POSE_BYTES} are accepted")
    if payload.lstrip()[:1] == b"{":  # no msgpack map begins like that
        try:  # so that the same limits and checks hold for both
            payload = msgspec.msgpack.encode(msgspec.json.decode(payload))
        except (ValueError, RecursionError, OverflowError) as error:
            raise CodecError(f"{_WHAT}: not JSON: {error}") from error
    return check_header(unpack_header(payload, _WHAT), PoseMessage, _WHAT)
