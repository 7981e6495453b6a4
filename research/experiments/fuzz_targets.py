"""What unknown clients may send us, and how to spoil it: good inputs, mutations that keep their structure, and the
readers.

Inputs are plain bytes: a message is a payload of ``framing.pack_parts``, a log is its file. Mutations take a source of
chance and a way to spoil bytes, so that a fuzzer can bring its own.
"""

from __future__ import annotations

import os
import random
import struct
import tempfile
import types
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Union, cast, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
from mcap.opcode import Opcode

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.labels import NYU40
from semantic_mapper.mapping.changes import NONE_CLEARED
from semantic_mapper.queries.questions import (
    QUESTIONS,
    MapState,
    WeightsEntry,
    decode_answer,
    decode_question,
    encode_answer,
    encode_error,
    encode_request,
    read_name,
)
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.transport import codec
from semantic_mapper.transport.codec import pack_parts, unpack_parts
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import EndOfStream, FrameRefused, Status, StreamInfo
from semantic_mapper.transport.pose_message import PoseMessage, decode_pose, encode_pose
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

Spoil = Callable[[bytes], bytes]
_CAMERA = CameraIntrinsics(6.5, 6.0, 3.5, 2.5, 8, 6)
_MAGIC_BYTES = 8
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
# What fields of questions and answers hold; others get a value of their type.
_VALUES: dict[str, Any] = {
    "up": (0.0, 0.0, 1.0),
    "label_set": NYU40,
    "state": "in use",
    "versions": (WeightsEntry(1, "0" * 64, "in use", 0.7, 0.5, 8, "better"),),
    "cameras": ("front",),
    "cleared": NONE_CLEARED,
}
_CLASS_VARS = (ClassVar[bool],)
_STRANGE = (None, True, -1, 0, 2**63 - 1, 2**64 - 1, 1.5, float("nan"), "", "x" * 5000, b"\0\xff", [], [[[]]], {})


@dataclass(frozen=True, slots=True)
class Target:
    """One reader of foreign bytes.

    Args:
        seeds: Good inputs.
        read: Reads an input whole; whatever it raises beside ``SemanticMapperError`` is a bug.
        mutate: Spoils an input, with its structure in mind.
    """

    seeds: Callable[[], list[bytes]]
    read: Callable[[bytes], None]
    mutate: Callable[[bytes, random.Random, Spoil], bytes]


def flip(data: bytes, rng: random.Random) -> bytes:
    """Spoil bytes without a fuzzer: bits, cuts, noise."""
    kind = rng.randrange(4)
    if kind == 0 or not data:
        return data + rng.randbytes(rng.randint(1, 16))
    at = rng.randrange(len(data))
    if kind == 1:
        return data[:at]
    if kind == 2:
        return data[:at] + rng.randbytes(rng.randint(1, 8)) + data[at + rng.randint(0, 8) :]
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]


def frame(seq: int = 3) -> PosedFrame:
    """A posed frame of 8 x 6 pixels."""
    rng = np.random.default_rng(seq)
    depth = (rng.integers(0, 5000, (6, 8)) / 1000).astype(np.float32)
    label = rng.integers(0, 41, (6, 8)).astype(np.uint8)
    rgb = rng.integers(0, 256, (6, 8, 3), np.uint8)
    return PosedFrame(10**15 + seq, seq, "front", rgb, depth, label, _CAMERA, np.eye(4), "odometry", 0.01)


def _info() -> StreamInfo:
    return StreamInfo("room", {"front": _CAMERA}, NYU40, 2, 6.0, {"place": "here"})


def _messages() -> list[bytes]:
    options = (CodecOptions(), CodecOptions(rgb="raw"), CodecOptions(rgb="jpeg"))
    f = frame()
    assert f.depth_m is not None and f.label is not None
    confidence = np.full_like(f.depth_m, 0.5)
    update = MapUpdate(5, 3, "front", True, False, (0, 2), f.label, confidence, f.depth_m, 12, 4)
    others = (
        codec.encode(update),
        codec.encode(update, CodecOptions()),
        codec.encode(FrameRefused(4, 5, "front", "pose holds NaN")),
        codec.encode(Status("mapper", "degraded", 5, {"fused": 7}, {"frame": 0.25}, ("no GPU",))),
        codec.encode(_info()),
        codec.encode(EndOfStream("player", "end", 200, "", ("damaged",))),
    )
    return [pack_parts(parts) for parts in (*(codec.encode_frame(f, o) for o in options), *others)]


def _read_message(data: bytes) -> None:
    parts = unpack_parts(data)
    for read in (codec.read_envelope, codec.decode):
        try:
            read(parts)
        except SemanticMapperError:
            continue


def _example(name: str, hint: Any) -> Any:
    """A value of a field of a question or an answer."""
    if get_origin(hint) is np.ndarray:
        return np.zeros((2, 3), get_args(get_args(hint)[1])[0])
    if name in _VALUES:
        return _VALUES[name]
    if get_origin(hint) in (Union, types.UnionType):
        return _example(name, next(part for part in get_args(hint) if part is not types.NoneType))
    if get_origin(hint) is Annotated:
        return _example(name, get_args(hint)[0])
    if get_origin(hint) is tuple:
        return tuple(_example("", part) for part in get_args(hint) if part is not Ellipsis)
    if get_origin(hint) is Mapping:
        return {_example("", get_args(hint)[0]): _example("", get_args(hint)[1])}
    if hint in (int, float, bool, str):
        return hint(1)
    fields = {key: part for key, part in get_type_hints(hint, include_extras=True).items() if part not in _CLASS_VARS}
    return hint(**{key: _example(key, part) for key, part in fields.items()})


def _questions() -> list[bytes]:
    """One of each kind."""
    return [pack_parts(encode_request(kind, _example("", question.request))) for kind, question in QUESTIONS.items()]


def _read_question(data: bytes) -> None:
    decode_question(unpack_parts(data))


def _answers() -> list[bytes]:
    """One to each kind of question, and an error."""
    state = MapState("map", 3, 1)
    good = [encode_answer(kind, state, _example("", question.answer)) for kind, question in QUESTIONS.items()]
    return [pack_parts(parts) for parts in (*good, encode_error(MapError("no such class")))]


def _read_answer(data: bytes) -> None:
    parts = unpack_parts(data)
    name = read_name(parts)
    name = name if name in QUESTIONS else "at"
    decode_answer(name, QUESTIONS[name].answer, parts)


def _poses() -> list[bytes]:
    message = PoseMessage(stamp_ns=5, position=(1.0, 2.0, 3.0), quaternion=(0.0, 0.0, 0.0, 1.0), parent="odom")
    words = b'{"v":1,"stamp_ns":5,"position":[1,2,3],"quaternion":[0,0,0,1]}'
    return [pack_parts(encode_pose(message)), pack_parts([words])]


def _read_pose(data: bytes) -> None:
    decode_pose(unpack_parts(data))


def mutate_message(data: bytes, rng: random.Random, spoil: Spoil) -> bytes:
    """Spoil one part, or one value of the header; sizes in the header are mostly made to fit."""
    try:
        parts = unpack_parts(data)
    except SemanticMapperError:
        return spoil(data)
    if not parts:
        return spoil(data)
    kind = rng.randrange(8)
    index = rng.randrange(len(parts))
    if kind == 0:
        return spoil(data)
    if kind == 1:
        parts = parts[:index] if rng.random() < 0.5 else [*parts, rng.randbytes(8)]
    elif kind < 5 or len(parts) < 2:
        parts[index] = spoil(parts[index])
        if rng.random() < 0.8:
            _fit_sizes(parts)
    else:
        try:
            header = msgpack.unpackb(parts[1], strict_map_key=False)
            _spoil_value(header, rng, spoil)
            parts[1] = cast(bytes, msgpack.packb(header, use_bin_type=True))
        except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException):
            parts[1] = spoil(parts[1])
    return pack_parts(parts)


def _fit_sizes(parts: list[bytes]) -> None:
    """Let the header announce the buffers as long as they are, so that their decoders get to see them."""
    try:
        header = msgpack.unpackb(parts[1], strict_map_key=False)
        specs: list[Any] = [header[name] for name in ("rgb", "label", "confidence", "depth") if header.get(name)]
        if isinstance(header.get("arrays"), list):
            specs = header["arrays"]
        elif "rgb" in header:
            specs = [header[name] for name in ("rgb", "depth", "label") if header.get(name)]
        for spec, part in zip(specs, parts[2:], strict=False):
            spec["bytes"] = len(part)
        parts[1] = cast(bytes, msgpack.packb(header, use_bin_type=True))
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError, OverflowError, msgpack.UnpackException):
        return


def _spoil_value(value: Any, rng: random.Random, spoil: Spoil) -> None:
    """Somewhere in a header: another value, a missing or an unknown one."""
    while isinstance(value, dict | list) and value:
        key = rng.choice(list(value)) if isinstance(value, dict) else rng.randrange(len(value))
        inner = value[key]
        if isinstance(inner, dict | list) and inner and rng.random() < 0.7:
            value = inner
            continue
        kind = rng.randrange(5)
        if kind == 0:
            del value[key]
        elif kind == 1 and isinstance(inner, str):
            value[key] = spoil(inner.encode(errors="replace")).decode(errors="replace")
        elif kind == 2 and isinstance(inner, int | float):
            value[key] = rng.choice((inner + 1, -inner, inner * 2, inner / 3, 2 ** rng.randrange(70)))
        elif kind == 3 and isinstance(value, dict):
            value[rng.choice(("never", 7))] = rng.choice(_STRANGE)
        else:
            value[key] = rng.choice(_STRANGE)
        return


def _logs() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        with LogWriter(path, _info()) as log:
            for seq in range(3):
                log.write_frame(frame(seq))
        whole = path.read_bytes()
    return [whole, whole[: len(whole) // 2]]


def _read_log(data: bytes) -> None:
    """Everything that a reader offers."""
    fd = os.memfd_create("log")
    try:
        os.write(fd, data)
        with LogReader(Path(f"/proc/self/fd/{fd}"), allow_empty=True) as log:
            for _ in log.messages():
                pass
            for _ in log:
                pass
    finally:
        os.close(fd)


def mutate_log(data: bytes, rng: random.Random, spoil: Spoil) -> bytes:
    """Spoil one record and make its length and checksum fit; or repeat, drop or swap records; or any byte."""
    records = _records(data)
    kind = rng.randrange(8)
    if kind == 0 or not records:
        return spoil(data)
    index, other = rng.randrange(len(records)), rng.randrange(len(records))
    if kind == 1:
        records[index], records[other] = records[other], records[index]
    elif kind == 2:
        records.insert(other, records[index])
    elif kind == 3:
        del records[index]
    else:
        records[index] = _spoil_record(*records[index], rng, spoil)
    whole = b"".join(_RECORD.pack(opcode & 0xFF, len(body)) + body for opcode, body in records)
    return data[:_MAGIC_BYTES] + whole + (data[-_MAGIC_BYTES:] if rng.random() < 0.9 else b"")


def _records(data: bytes) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    at = _MAGIC_BYTES
    while at + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        if at + _RECORD.size + length > len(data):
            break
        found.append((opcode, data[at + _RECORD.size : at + _RECORD.size + length]))
        at += _RECORD.size + length
    return found


def _spoil_record(opcode: int, body: bytes, rng: random.Random, spoil: Spoil) -> tuple[int, bytes]:
    """A chunk's messages are spoiled within; its checksums, and an attachment's, mostly fit again."""
    if rng.random() < 0.1:
        return rng.randrange(1, 16), body
    if opcode == Opcode.CHUNK and len(body) > _CHUNK.size + 8 and rng.random() < 0.8:
        start, end, *_ = _CHUNK.unpack_from(body)
        inner = _RECORD.size + 22  # a message's head: channel, sequence, two times
        records = body[_CHUNK.size + 8 :]
        name = rng.choice((b"", b"", b"", b"", b"zstd", b"lz4", b"xz"))
        opcode_in = records[:1] if len(records) > inner else b""
        if opcode_in == bytes([Opcode.MESSAGE]):
            payload = mutate_message(records[inner:], rng, spoil)
            records = _RECORD.pack(Opcode.MESSAGE, 22 + len(payload)) + records[_RECORD.size : inner] + payload
        else:
            records = spoil(records)
        size = len(records) if rng.random() < 0.9 else rng.randrange(1 << 40)
        head = _CHUNK.pack(start, end, size, zlib.crc32(records), len(name)) + name
        return opcode, head + struct.pack("<Q", len(records)) + records
    body = spoil(body)
    if opcode == Opcode.ATTACHMENT and len(body) > 4 and rng.random() < 0.9:
        body = body[:-4] + struct.pack("<I", zlib.crc32(body[:-4]))
    return opcode, body


TARGETS = {
    "message": Target(_messages, _read_message, mutate_message),
    "log": Target(_logs, _read_log, mutate_log),
    "question": Target(_questions, _read_question, mutate_message),
    "answer": Target(_answers, _read_answer, mutate_message),
    "pose": Target(_poses, _read_pose, mutate_message),
}
