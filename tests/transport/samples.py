"""Messages of every kind, small, and ways to spoil them."""

import random
from collections.abc import Sequence

import msgpack
import numpy as np

from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.labels import NYU40
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.images import CodecOptions, depth_from_uint16
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame
from tests.contract import samples as contract

INTRINSICS = CameraIntrinsics(20.5, 21.0, 11.5, 8.5, 24, 18)
CAMERA = "front"


def make_frame(
    seq: int = 3,
    *,
    depth: bool = True,
    label: bool = True,
    camera_id: str = CAMERA,
    size: tuple[int, int] = (INTRINSICS.width, INTRINSICS.height),
) -> PosedFrame:
    shape = size[::-1]
    rng = np.random.default_rng(seq)
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = rng.normal(size=3)
    return PosedFrame(
        stamp_ns=10**18 + seq,
        seq=seq,
        camera_id=camera_id,
        rgb=rng.integers(0, 256, (*shape, 3), np.uint8),
        depth_m=depth_from_uint16(rng.integers(0, 5000, shape).astype(np.uint16), 1000) if depth else None,
        label=rng.integers(0, 41, shape).astype(np.uint8) if label else None,
        intrinsics=scale_intrinsics(INTRINSICS, *size),
        T_world_camera=T_world_camera,
        pose_source="odometry",
        pose_sigma=0.01,
    )


def make_update(seq: int = 3, camera_id: str = CAMERA) -> MapUpdate:
    rng = np.random.default_rng(seq)
    return MapUpdate(
        stamp_ns=10**18 + seq,
        seq=seq,
        camera_id=camera_id,
        fused=True,
        is_keyframe=False,
        source_seqs=(0, 2),
        label=rng.integers(0, 41, (18, 24)).astype(np.uint8),
        confidence=rng.random((18, 24), np.float32),
        depth_m=rng.random((18, 24), np.float32),
        blocks=12,
        blocks_touched=4,
        stage_ms={"encode": 1.5, "fuse": 3.0},
    )


def make_info() -> StreamInfo:
    return StreamInfo("folder kitchen", {CAMERA: INTRINSICS}, NYU40, 200, 6.0, {"place": "Küche"})


def all_messages() -> dict[str, list[bytes]]:
    """Messages of each topic, and frames in every packing."""
    return {name: encode(message, CodecOptions(**more)) for name, (_, message, more) in contract.messages().items()}


def with_header(parts: Sequence[bytes], **changes: object) -> list[bytes]:
    return [parts[0], msgpack.packb({**msgpack.unpackb(parts[1]), **changes}), *parts[2:]]


def deep_bomb(depth: int) -> bytes:
    """Arrays in arrays."""
    return b"\x91" * depth + b"\xc0"


STRANGE_VALUES: tuple[object, ...] = (
    *(None, True, -1, 0, 2**63 - 1, 2**64 - 1, -(2**63), 1.5, float("nan"), float("inf")),
    *("", "x" * 5000, "../../etc", b"\x00\xff", [], [[[]]], {}, {"v": 1}, list(range(2000))),
)


def mutate(parts: Sequence[bytes], rng: random.Random) -> list[bytes]:
    """Spoil a good message in one of many ways; may, rarely, leave it good."""
    parts = list(parts)
    kind = rng.randrange(9)
    index = rng.randrange(len(parts))
    if kind == 0:  # flip bits
        data = bytearray(parts[index])
        for _ in range(rng.randint(1, 4)):
            if data:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        parts[index] = bytes(data)
    elif kind == 1:  # cut
        parts[index] = parts[index][: rng.randrange(len(parts[index]) + 1)]
    elif kind == 2:  # lengthen
        parts[index] += rng.randbytes(rng.randint(1, 64))
    elif kind == 3:  # another number of parts
        parts = parts[:index] if rng.random() < 0.5 else parts + [rng.randbytes(8)] * rng.randint(1, 12)
    elif kind == 4:  # noise instead
        parts[index] = rng.randbytes(rng.randrange(200))
    elif kind == 5:  # swap two parts
        other = rng.randrange(len(parts))
        parts[index], parts[other] = parts[other], parts[index]
    elif kind == 6 and len(parts) > 1:  # a bomb for a header
        parts[1] = rng.choice((deep_bomb(100_000), b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xc1", b""))
    elif len(parts) > 1:  # a strange value somewhere in the header
        header = msgpack.unpackb(parts[1])
        _spoil(header, rng)
        parts[1] = msgpack.packb(header)
    return parts


def _spoil(value: object, rng: random.Random) -> None:
    while isinstance(value, dict) and value:
        key = rng.choice(list(value))
        inner = value[key]
        if isinstance(inner, dict) and inner and rng.random() < 0.7:
            value = inner
            continue
        what = rng.randrange(3)
        if what == 0:
            value[key] = rng.choice(STRANGE_VALUES)
        elif what == 1:
            del value[key]
        else:
            value["never_heard_of"] = rng.choice(STRANGE_VALUES)
        return
