"""Messages as bytes: exact round trips, and one clear error for anything else, before anything is allocated."""

import dataclasses
import random
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semantic_mapper.errors import CodecError
from semantic_mapper.labels import NYU40
from semantic_mapper.transport.codec import (
    EncodedImage,
    decode,
    decode_as,
    encode,
    encode_frame,
    pack_parts,
    read_envelope,
    repack_rgb,
    unpack_parts,
)
from semantic_mapper.transport.images import CodecOptions, depth_from_uint16, depth_to_uint16, encode_uint8, sniff_image
from semantic_mapper.transport.messages import MAX_KEYFRAME_BYTES, MAX_WEIGHTS_BYTES, LabelledKeyframe, WeightsUpdate
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

from . import samples
from .samples import with_header

sizes = st.tuples(st.integers(1, 20), st.integers(1, 20))
camera_ids = st.from_regex(r"[A-Za-z0-9_.:-]{1,64}", fullmatch=True)


@st.composite
def frames(draw: st.DrawFn) -> PosedFrame:
    height, width = draw(sizes)
    metres = hnp.arrays(np.float32, (height, width), elements=st.floats(width=32))
    units = hnp.arrays(np.uint16, (height, width)).map(lambda raw: depth_from_uint16(raw, 1000.0))
    focal = draw(st.floats(0.1, 100)) * max(width, height)
    return PosedFrame(
        stamp_ns=draw(st.integers(0, 2**62)),
        seq=draw(st.integers(0, 2**63 - 1)),
        camera_id=draw(camera_ids),
        rgb=draw(hnp.arrays(np.uint8, (height, width, 3))),
        depth_m=draw(st.none() | units | metres),
        label=draw(st.none() | hnp.arrays(np.uint8, (height, width))),
        intrinsics=CameraIntrinsics(focal, focal, draw(st.floats(-1, 1)), 0.5, width, height),
        T_world_camera=draw(
            hnp.arrays(np.float64, (4, 4), elements=st.floats(allow_nan=False, allow_infinity=False, width=64))
        ),
        pose_source=draw(st.text(max_size=20)),
        pose_sigma=draw(st.floats(0, 10)),
    )


def assert_same_frame(a: PosedFrame, b: PosedFrame) -> None:
    for name in ("stamp_ns", "seq", "camera_id", "intrinsics", "pose_source", "pose_sigma"):
        assert getattr(a, name) == getattr(b, name), name
    for name in ("T_world_camera", "rgb", "depth_m", "label"):
        mine, theirs = getattr(a, name), getattr(b, name)
        assert (mine is None) == (theirs is None) and (mine is None or mine.tobytes() == theirs.tobytes()), name
        assert mine is None or mine.flags.writeable, name


@given(frames(), st.sampled_from(("png", "raw")))
def test_a_frame_survives_wire_and_log_bit_for_bit_and_may_be_written_to(frame: PosedFrame, rgb) -> None:
    parts = encode_frame(frame, CodecOptions(rgb=rgb))
    assert_same_frame(decode_as(PosedFrame, unpack_parts(pack_parts(parts))), frame)


@given(hnp.arrays(np.uint16, sizes), st.sampled_from((1.0, 1000.0, 5000.0, 999.7)))
def test_depth_from_a_sensor_is_sent_as_its_own_units(raw, scale) -> None:
    units = depth_to_uint16(depth_from_uint16(raw, scale), scale)
    assert units is not None and np.array_equal(units, raw)
    for value in (np.nan, np.inf, -0.001, -0.0, 65.5361, 1.00005, 1e30):  # no multiple of the unit: sent as floats
        assert depth_to_uint16(np.array([[1.0, value]], np.float32), 1000.0) is None


def test_an_image_file_is_sent_as_it_is_and_packed_again_without_touching_anything_else() -> None:
    frame = samples.make_frame(label=False)
    envelope = read_envelope(encode_frame(frame))
    assert (envelope.topic, envelope.source, envelope.stamp_ns, envelope.seq) == ("frame", "front", frame.stamp_ns, 3)
    assert envelope.T_world_camera == tuple(frame.T_world_camera.ravel())
    assert envelope.has_depth and not envelope.has_label
    done, data = cv2.imencode(".jpg", frame.rgb)
    assert done
    parts = encode_frame(frame, encoded_rgb=EncodedImage("jpeg", data.tobytes()))
    assert parts[2] == data.tobytes()
    assert np.array_equal(decode_as(PosedFrame, parts).rgb[..., ::-1], cv2.imdecode(data, cv2.IMREAD_COLOR))
    raw = encode_frame(frame, CodecOptions(rgb="raw"))
    png = repack_rgb(raw, CodecOptions(rgb="png"))
    assert png[2].startswith(b"\x89PNG") and png[3:] == raw[3:]
    assert repack_rgb(png, CodecOptions(rgb="raw")) == raw  # there and back, header included


def test_a_map_update_is_exact_but_for_confidence_which_is_to_one_255th() -> None:
    update, moving, T = samples.make_update(), np.zeros((18, 24), np.bool_), np.eye(4)
    assert encode(dataclasses.replace(update, moving=moving)) == encode(update), "nothing moves"
    moving[2:5, 3], T[:3, 3] = True, (1.25, -0.1, 1 / 3)
    sent = dataclasses.replace(update, moving=moving, world=7, T_map_world=T)
    back, envelope = decode_as(MapUpdate, encode(sent)), read_envelope(encode(sent))
    for name in ("label", "depth_m", "moving", "T_map_world"):
        assert np.array_equal(getattr(back, name), getattr(sent, name)), name
    assert np.abs(back.confidence - update.confidence).max() <= 0.5 / 255 + 1e-6
    for name in ("stamp_ns", "seq", "camera_id", "fused", "is_keyframe", "source_seqs", "blocks", "stage_ms", "world"):
        assert getattr(back, name) == getattr(sent, name), name
    assert envelope.world == 7 and envelope.T_map_world == tuple(T.ravel())
    for name, value in ("T_world_camera", np.full((4, 4), np.nan)), ("camera_id", "left eye"):
        with pytest.raises(CodecError, match=r"T_world_camera|cannot be the name of a camera"):
            encode_frame(dataclasses.replace(samples.make_frame(), **{name: value}))
    for wrong, says in ({"moving": moving[1:]}, "size of label"), ({"confidence": update.confidence + 2}, r"\[0, 1\]"):
        with pytest.raises(CodecError, match=says):
            encode(dataclasses.replace(update, **wrong))


def test_a_keyframe_survives_and_what_cannot_be_learned_from_is_refused() -> None:
    frame = samples.make_frame()
    parts = encode(LabelledKeyframe(frame, NYU40, "a person"))
    keyframe, envelope = decode_as(LabelledKeyframe, parts), read_envelope(parts)
    assert_same_frame(keyframe.frame, frame)
    assert (keyframe.label_set, keyframe.teacher) == (NYU40, "a person")
    assert (envelope.source, envelope.stamp_ns, envelope.has_label) == ("front", frame.stamp_ns, True)
    with pytest.raises(CodecError, match="nothing to learn"):
        encode(LabelledKeyframe(samples.make_frame(label=False), NYU40))
    with pytest.raises(CodecError, match="has no label image"):
        decode([*parts[:2], *encode_frame(samples.make_frame(label=False))[1:]])
    with pytest.raises(CodecError, match="has no frame"):
        decode(parts[:2])
    weights = samples.all_messages()["weights"]
    other = bytes([weights[2][0] ^ 1]) + weights[2][1:]
    for bad, says in (
        ([*weights[:2], other], "not the one that its digest names"),
        (with_header(weights, bytes=MAX_WEIGHTS_BYTES + 1), "bytes"),
        (with_header(weights, digest="../../etc"), "digest"),
    ):
        with pytest.raises(CodecError, match=says):
            decode_as(WeightsUpdate, bad)


@contextmanager
def allocates_nothing() -> Iterator[None]:
    """Less than a megabyte."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def lens(width: int, height: int) -> dict[str, float]:
    """Intrinsics of an ordinary camera, as the header has them."""
    return {"fx": width, "fy": width, "cx": width / 2, "cy": height / 2, "width": width, "height": height}


def test_a_keyframe_is_bounded_as_a_whole() -> None:
    parts = encode(LabelledKeyframe(samples.make_frame(), NYU40))
    wide = with_header([b"", parts[2]], intrinsics=lens(1 << 12, (1 << 11) + 1))[1]
    padding = bytes(MAX_KEYFRAME_BYTES // 2)
    rgb, label = {"encoding": "png", "bytes": len(padding)}, {"encoding": "u8_zstd", "bytes": len(padding)}
    long = with_header([b"", parts[2]], rgb=rgb, depth=None, label=label)[1]
    for bad, says in (
        ([*parts[:2], wide, *parts[3:]], "a keyframe has at most 8388608 pixels"),
        ([*parts[:2], long, padding, padding], "a keyframe has at most 67633152"),
    ):
        for read in (decode, read_envelope):
            with allocates_nothing(), pytest.raises(CodecError, match=says):
                read(bad)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"intrinsics": {**lens(24, 18), "cy": 1e19}}, "cy=1e.19 do not fit a 24x18 image"),
        ({"stamp_ns": 2**62 + 1}, "stamp_ns"),
        ({"v": 2}, "protocol version 2"),
        ({"seq": "three"}, "seq"),
        ({"seq": -1}, "seq"),
        ({"seq": True}, "seq"),
        ({"pose_sigma": float("nan")}, "pose_sigma"),
        ({"T_world_camera": [float("inf")] * 16}, r"finite numbers .*T_world_camera\[0\]"),
        ({"T_world_camera": [0.0] * 15}, "T_world_camera"),
        ({"colour": 1}, "unknown field `colour`"),
        ({"camera_id": "a/b"}, "camera_id"),
        ({"camera_id": "back"}, "carries a message of 'back'"),
        ({"rgb": {"encoding": "bmp", "bytes": 3}}, "rgb"),
        ({"rgb": {"encoding": "png", "bytes": 2**62}}, "rgb"),
        ({"depth": None}, "announces buffers"),
        ({"intrinsics": lens(16384, 16384)}, "is too large"),
        ({"intrinsics": lens(16384, 2049)}, "is too large"),
        ({"intrinsics": lens(4000, 3000)}, "4000x3000"),
    ],
)
@pytest.mark.parametrize("rgb", ["png", "raw"])
def test_a_wrong_header_is_refused_by_its_field(changes: dict[str, object], complaint: str, rgb) -> None:
    parts = with_header(encode_frame(samples.make_frame(), CodecOptions(rgb=rgb)), **changes)
    with allocates_nothing(), pytest.raises(CodecError, match=complaint):
        decode(parts)


@pytest.mark.parametrize("topic", b" frame frame/ frame/a frame/a/b/ frames/a/ \xff/a/ frame/\x01/".split(b" "))
def test_foreign_topics_are_refused(topic: bytes) -> None:
    with pytest.raises(CodecError, match="unknown topic"):
        decode([topic, b"\x80"])


def test_bombs_in_buffers_are_refused_before_they_unfold() -> None:
    bomb = zstandard.compress(bytes(10**9), 1)
    parts = encode_frame(samples.make_frame(depth=False))
    parts = with_header(parts, label={"encoding": "u8_zstd", "bytes": len(bomb)})
    with allocates_nothing(), pytest.raises(CodecError, match="announce 1000000000 bytes"):
        decode([*parts[:3], bomb])
    parts = unpack_parts((Path(__file__).with_name("crashers") / "png-bomb.msg").read_bytes())
    with pytest.raises(CodecError, match=r"PNG image|bad header"):
        decode(parts)
    with pytest.raises(CodecError, match="PNG image"):
        sniff_image(parts[2])


def test_thousands_of_random_and_mutated_messages_raise_nothing_but_codec_errors() -> None:
    rng = random.Random(0)
    good = list(samples.all_messages().values())
    refused = 0
    for _ in range(5_000):
        if rng.random() < 0.2:
            topic = rng.choice((b"frame/front/", b"map/front/", b"status/m/", rng.randbytes(12)))
            parts = [topic, *(rng.randbytes(rng.randrange(100)) for _ in range(rng.randrange(6)))]
        else:
            parts = samples.mutate(rng.choice(good), rng)
        try:
            decode(parts)
        except CodecError:
            refused += 1
    assert refused > 4_000  # a flipped bit in a pixel cannot be seen; nearly all else can


@given(st.binary(max_size=300) | st.sampled_from((samples.deep_bomb(10**5), msgpack.packb([b""] * 9), b"\xc0")))
def test_a_payload_that_is_no_framed_message_is_refused(payload: bytes) -> None:
    try:
        parts = unpack_parts(payload)
    except CodecError:
        return
    assert len(parts) <= 8 and all(isinstance(part, bytes) for part in parts)


def test_a_compressed_image_takes_no_more_memory_than_it_is_long():
    image = np.zeros((480, 640), np.uint8)
    encode_uint8(image)  # makes the compressor of this thread
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        _, packed = encode_uint8(image)
        assert tracemalloc.get_traced_memory()[0] - before < len(packed) + 1000
    finally:
        tracemalloc.stop()
