from __future__ import annotations

import dataclasses
import random
import tracemalloc
from pathlib import Path

import cv2
import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semantic_mapper.errors import CodecError
from semantic_mapper.labels import CAMVID11, NYU40
from semantic_mapper.transport.codec import (
    EncodedImage,
    decode,
    decode_as,
    encode,
    encode_frame,
    pack_parts,
    read_envelope,
    unpack_parts,
)
from semantic_mapper.transport.images import CodecOptions, depth_from_uint16, depth_to_uint16, sniff_image
from semantic_mapper.transport.messages import (
    MAX_KEYFRAME_BYTES,
    MAX_WEIGHTS_BYTES,
    EndOfStream,
    FrameRefused,
    LabelledKeyframe,
    Status,
    StreamInfo,
    WeightsInUse,
    WeightsUpdate,
)
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

from . import samples

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
sizes = st.tuples(st.integers(1, 20), st.integers(1, 20))
camera_ids = st.from_regex(r"[A-Za-z0-9_.:-]{1,64}", fullmatch=True)


@st.composite
def frames(draw: st.DrawFn) -> PosedFrame:
    height, width = draw(sizes)
    metres = hnp.arrays(np.float32, (height, width), elements=st.floats(width=32))
    units = hnp.arrays(np.uint16, (height, width)).map(lambda raw: depth_from_uint16(raw, 1000.0))
    return PosedFrame(
        stamp_ns=draw(st.integers(0, 2**62)),
        seq=draw(st.integers(0, 2**63 - 1)),
        camera_id=draw(camera_ids),
        rgb=draw(hnp.arrays(np.uint8, (height, width, 3))),
        depth_m=draw(st.none() | units | metres),
        label=draw(st.none() | hnp.arrays(np.uint8, (height, width))),
        intrinsics=CameraIntrinsics(
            draw(st.floats(0.1, 100)) * width,
            draw(st.floats(0.1, 100)) * height,
            draw(st.floats(-1, 1)),
            0.5,
            width,
            height,
        ),
        T_world_camera=draw(hnp.arrays(np.float64, (4, 4), elements=finite)),
        pose_source=draw(st.text(max_size=20)),
        pose_sigma=draw(st.floats(0, 10)),
    )


def assert_same_frame(a: PosedFrame, b: PosedFrame) -> None:
    for name in ("stamp_ns", "seq", "camera_id", "intrinsics", "pose_source", "pose_sigma"):
        assert getattr(a, name) == getattr(b, name), name
    assert a.T_world_camera.tobytes() == b.T_world_camera.tobytes()
    assert np.array_equal(a.rgb, b.rgb)
    for mine, theirs in ((a.depth_m, b.depth_m), (a.label, b.label)):
        assert (mine is None) == (theirs is None)
        assert mine is None or theirs is None or mine.tobytes() == theirs.tobytes()


@given(frames(), st.sampled_from(("png", "raw")))
def test_a_frame_survives_wire_and_log_bit_for_bit(frame: PosedFrame, rgb) -> None:
    parts = encode_frame(frame, CodecOptions(rgb=rgb))
    assert_same_frame(decode_as(PosedFrame, unpack_parts(pack_parts(parts))), frame)


@given(hnp.arrays(np.uint16, sizes), st.sampled_from((1.0, 1000.0, 5000.0, 999.7)))
def test_depth_from_a_sensor_is_sent_as_its_own_units(raw, scale) -> None:
    units = depth_to_uint16(depth_from_uint16(raw, scale), scale)
    assert units is not None and np.array_equal(units, raw)


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.001, -0.0, 65.5361, 1.00005, 1e30])
def test_depth_that_is_no_multiple_of_the_unit_falls_back_to_float(value: float) -> None:
    depth = np.array([[1.0, value]], np.float32)
    assert depth_to_uint16(depth, 1000.0) is None
    intrinsics = CameraIntrinsics(1, 1, 0, 0, 2, 1)
    frame = PosedFrame(0, 0, "a", np.zeros((1, 2, 3), np.uint8), depth, None, intrinsics, np.eye(4))
    assert_same_frame(decode_as(PosedFrame, encode_frame(frame)), frame)


def test_depth_views_that_are_not_contiguous_are_sent_right() -> None:
    frame = samples.make_frame()
    assert frame.depth_m is not None and frame.label is not None
    turned = dataclasses.replace(
        frame,
        rgb=frame.rgb[::-1, ::-1],
        depth_m=frame.depth_m[::-1, ::-1] * np.float32(1.01),
        label=frame.label[::-1, ::-1],
    )
    for options in (CodecOptions(), CodecOptions(rgb="raw")):
        assert_same_frame(decode_as(PosedFrame, encode_frame(turned, options)), turned)


def test_an_image_file_is_sent_as_it_is() -> None:
    frame = samples.make_frame()
    done, data = cv2.imencode(".jpg", frame.rgb)
    assert done
    parts = encode_frame(frame, encoded_rgb=EncodedImage("jpeg", data.tobytes()))
    assert parts[2] == data.tobytes()
    assert np.array_equal(decode_as(PosedFrame, parts).rgb[..., ::-1], cv2.imdecode(data, cv2.IMREAD_COLOR))


def test_decoded_arrays_may_be_written_to() -> None:
    for parts in samples.frame_variants():
        frame = decode_as(PosedFrame, parts)
        assert frame.rgb.flags.writeable and frame.T_world_camera.flags.writeable
        assert frame.depth_m is None or frame.depth_m.flags.writeable
        assert frame.label is None or frame.label.flags.writeable


def test_a_map_update_keeps_labels_and_depth_exactly_and_confidence_to_one_255th() -> None:
    update = samples.make_update()
    back = decode_as(MapUpdate, encode(update))
    assert np.array_equal(back.label, update.label) and np.array_equal(back.depth_m, update.depth_m)
    assert np.abs(back.confidence - update.confidence).max() <= 0.5 / 255 + 1e-6
    for name in ("stamp_ns", "seq", "camera_id", "fused", "is_keyframe", "source_seqs", "blocks", "stage_ms"):
        assert getattr(back, name) == getattr(update, name), name


def test_what_moves_is_sent_where_something_does() -> None:
    update = samples.make_update()
    moving = np.zeros(update.label.shape, np.bool_)
    for nothing in (None, moving):
        parts = encode(dataclasses.replace(update, moving=nothing))
        assert decode_as(MapUpdate, parts).moving is None and parts == encode(update), "as older releases read it"
    moving[2:5, 3] = True
    assert np.array_equal(decode_as(MapUpdate, encode(dataclasses.replace(update, moving=moving))).moving, moving)
    with pytest.raises(CodecError, match="must have the size of label"):
        encode(dataclasses.replace(update, moving=moving[1:]))


def test_where_the_map_has_the_world_of_a_frame_is_sent_where_it_is_another() -> None:
    update, T = samples.make_update(), np.eye(4)
    T[:3, 3] = 1.25, -0.1, 1 / 3
    assert np.array_equal(decode_as(MapUpdate, encode(update)).T_map_world, np.eye(4))
    parts = encode(dataclasses.replace(update, world=7, T_map_world=T))
    back, envelope = decode_as(MapUpdate, parts), read_envelope(parts)
    assert back.world == envelope.world == 7 and np.array_equal(back.T_map_world, T)
    assert envelope.T_map_world == tuple(T.ravel())


@pytest.mark.parametrize("label_set", [None, NYU40, CAMVID11])
def test_stream_info_survives(label_set) -> None:
    info = msgspec.structs.replace(samples.make_info(), label_set=label_set)
    assert decode_as(StreamInfo, encode(info)) == info
    assert decode_as(StreamInfo, encode(StreamInfo("bare"))) == StreamInfo("bare")


def test_small_messages_survive() -> None:
    assert decode_as(Status, encode(samples.make_status())) == samples.make_status()
    assert decode_as(Status, encode(Status("m", "running", 0))) == Status("m", "running", 0)
    refused = FrameRefused(1, 2, "front", "pose holds NaN")
    assert decode_as(FrameRefused, encode(refused)) == refused
    end = EndOfStream("player", "error", 3, "the mapper has gone", ("frame seq=2: CRC",))
    assert decode_as(EndOfStream, encode(end)) == end


def test_messages_of_learning_survive() -> None:
    assert decode_as(WeightsUpdate, encode(samples.make_weights())) == samples.make_weights()
    assert decode_as(WeightsInUse, encode(samples.make_in_use())) == samples.make_in_use()
    frame = samples.make_frame()
    keyframe = decode_as(LabelledKeyframe, encode(LabelledKeyframe(frame, NYU40, "a person")))
    assert (keyframe.label_set, keyframe.teacher, keyframe.frame.seq) == (NYU40, "a person", frame.seq)
    assert keyframe.frame.label is not None and np.array_equal(keyframe.frame.label, frame.label)
    envelope = read_envelope(encode(LabelledKeyframe(frame, NYU40)))
    assert (envelope.source, envelope.stamp_ns, envelope.has_label) == ("front", frame.stamp_ns, True)


def test_what_cannot_be_learned_from_is_refused() -> None:
    with pytest.raises(CodecError, match="nothing to learn"):
        encode(LabelledKeyframe(samples.make_frame(label=False), NYU40))
    parts = encode(LabelledKeyframe(samples.make_frame(), NYU40))
    with pytest.raises(CodecError, match="has no label image"):
        decode_as(LabelledKeyframe, [*parts[:2], *encode_frame(samples.make_frame(label=False))[1:]])
    with pytest.raises(CodecError, match="has no frame"):
        decode_as(LabelledKeyframe, parts[:2])
    weights = encode(samples.make_weights())
    other = bytes([weights[2][0] ^ 1]) + weights[2][1:]
    with pytest.raises(CodecError, match="not the one that its digest names"):
        decode_as(WeightsUpdate, [*weights[:2], other])
    with pytest.raises(CodecError, match="bytes"):
        decode_as(WeightsUpdate, with_header(weights, bytes=MAX_WEIGHTS_BYTES + 1))
    with pytest.raises(CodecError, match="digest"):
        decode_as(WeightsUpdate, with_header(weights, digest="../../etc"))


def test_the_envelope_tells_what_a_message_is_without_decoding_it() -> None:
    frame = samples.make_frame(label=False)
    envelope = read_envelope(encode_frame(frame))
    assert (envelope.topic, envelope.source, envelope.stamp_ns, envelope.seq) == ("frame", "front", frame.stamp_ns, 3)
    assert envelope.T_world_camera == tuple(frame.T_world_camera.ravel())
    assert envelope.has_depth and not envelope.has_label
    for name, parts in samples.all_messages().items():
        assert read_envelope(parts).topic == name


def test_a_keyframe_is_bounded_as_a_whole_before_anything_is_allocated() -> None:
    parts = encode(LabelledKeyframe(samples.make_frame(), NYU40))
    wide = with_header([b"", parts[2]], intrinsics=lens(1 << 12, (1 << 11) + 1))[1]
    padding = bytes(MAX_KEYFRAME_BYTES // 2)
    rgb, label = {"encoding": "png", "bytes": len(padding)}, {"encoding": "u8_zstd", "bytes": len(padding)}
    long = with_header([b"", parts[2]], rgb=rgb, depth=None, label=label)[1]
    tracemalloc.start()
    for bad, says in (
        ([*parts[:2], wide, *parts[3:]], "a keyframe has at most 8388608 pixels"),
        ([*parts[:2], long, padding, padding], "a keyframe has at most 67633152"),
    ):
        for read in (decode, read_envelope):
            with pytest.raises(CodecError, match=says):
                read(bad)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20
    size, small = (1 << 12, 1 << 12), samples.make_frame()
    large = dataclasses.replace(
        small,
        rgb=np.broadcast_to(np.uint8(0), (*size, 3)),
        depth_m=None,
        label=np.broadcast_to(np.uint8(1), size),
        intrinsics=CameraIntrinsics(**lens(size[1], size[0])),
    )
    with pytest.raises(CodecError, match="4096x4096"):
        encode(LabelledKeyframe(large, NYU40))


def with_header(parts: list[bytes], **changes: object) -> list[bytes]:
    header = {**msgpack.unpackb(parts[1]), **changes}
    return [parts[0], msgpack.packb(header), *parts[2:]]


def lens(width: int, height: int) -> dict[str, float]:
    """Intrinsics of an ordinary camera, as the header has them."""
    return {"fx": width, "fy": width, "cx": width / 2, "cy": height / 2, "width": width, "height": height}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"intrinsics": {**lens(24, 18), "cy": 1e19}}, "cy=1e.19 do not fit a 24x18 image"),
        ({"intrinsics": {**lens(24, 18), "fx": 1e-320}}, "do not fit"),
        ({"stamp_ns": 2**62 + 1}, "stamp_ns"),
        ({"pose_sigma": -1.0}, "pose_sigma"),
        ({"v": 2}, "protocol version 2"),
        ({"v": None}, "protocol version"),
        ({"seq": "three"}, "seq"),
        ({"seq": -1}, "seq"),
        ({"seq": True}, "seq"),
        ({"stamp_ns": 2**64 - 1}, "stamp_ns"),
        ({"pose_sigma": float("nan")}, "pose_sigma"),
        ({"T_world_camera": [float("inf")] * 16}, r"finite numbers .*T_world_camera\[0\]"),
        ({"T_world_camera": [0.0] * 15}, "T_world_camera"),
        ({"colour": 1}, "unknown field `colour`"),
        ({"camera_id": "a/b"}, "camera_id"),
        ({"camera_id": "back"}, "carries a message of 'back'"),
        ({"rgb": {"encoding": "bmp", "bytes": 3}}, "rgb"),
        ({"rgb": {"encoding": "png", "bytes": 2**62}}, "rgb"),
        ({"depth": None}, "announces buffers"),
    ],
)
def test_a_wrong_header_is_refused_by_its_field(changes: dict[str, object], complaint: str) -> None:
    with pytest.raises(CodecError, match=complaint):
        decode_as(PosedFrame, with_header(encode_frame(samples.make_frame()), **changes))


@pytest.mark.parametrize(
    "header", [samples.deep_bomb(10**5), b"\x81\xa1a" * 10**4, b"\xdd\xff\xff\xff\xff", b"\xc1", b""]
)
def test_bombs_for_headers_are_refused(header: bytes) -> None:
    with pytest.raises(CodecError):
        decode([b"frame/front/", header, b""])


@pytest.mark.parametrize(("width", "height"), [(16384, 16384), (16384, 2049)])
@pytest.mark.parametrize("options", [CodecOptions(rgb="raw"), CodecOptions()])
def test_an_absurd_size_is_refused_before_anything_is_allocated(width: int, height: int, options: CodecOptions) -> None:
    parts = encode_frame(samples.make_frame(), options)
    intrinsics = {**msgpack.unpackb(parts[1])["intrinsics"], "width": width, "height": height}
    tracemalloc.start()
    with pytest.raises(CodecError, match="is too large"):
        decode_as(PosedFrame, with_header(parts, intrinsics=intrinsics))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize("options", [CodecOptions(rgb="raw"), CodecOptions(), CodecOptions(rgb="jpeg")])
def test_buffers_that_do_not_fit_the_announced_size_are_refused(options: CodecOptions) -> None:
    parts = encode_frame(samples.make_frame(), options)
    with pytest.raises(CodecError, match="4000x3000"):
        decode_as(PosedFrame, with_header(parts, intrinsics=lens(4000, 3000)))


def test_a_compression_bomb_is_refused_before_it_unfolds() -> None:
    import zstandard

    bomb = zstandard.compress(bytes(10**9), 1)
    parts = encode_frame(samples.make_frame(depth=False))
    parts = with_header(parts, label={"encoding": "u8_zstd", "bytes": len(bomb)})
    with pytest.raises(CodecError, match="announce 1000000000 bytes"):
        decode_as(PosedFrame, [*parts[:3], bomb])


def test_a_frame_that_could_not_be_decoded_is_not_encoded() -> None:
    frame = samples.make_frame()
    pose = frame.T_world_camera.copy()
    pose[0, 0] = np.nan
    with pytest.raises(CodecError, match="T_world_camera"):
        encode_frame(dataclasses.replace(frame, T_world_camera=pose))
    with pytest.raises(CodecError, match="cannot be the name of a camera"):
        encode_frame(dataclasses.replace(frame, camera_id="left eye"))


@pytest.mark.parametrize("cut", [1, 20, 60])
@pytest.mark.parametrize("rgb", ["png", "jpeg"])
def test_a_cut_image_is_refused_not_painted_grey(rgb, cut: int) -> None:
    parts = encode_frame(samples.make_frame(depth=False, label=False), CodecOptions(rgb=rgb))
    image = parts[2][:-cut]
    with pytest.raises(CodecError):
        decode_as(PosedFrame, with_header([*parts[:2], image], rgb={"encoding": rgb, "bytes": len(image)}))


def test_ten_thousand_random_and_mutated_messages_raise_nothing_but_codec_errors() -> None:
    rng = random.Random(0)
    good = [*samples.all_messages().values(), *samples.frame_variants()]
    refused = 0
    for _ in range(10_000):
        if rng.random() < 0.2:
            topic = rng.choice((b"frame/front/", b"map/front/", b"status/m/", rng.randbytes(12)))
            parts = [topic, *(rng.randbytes(rng.randrange(100)) for _ in range(rng.randrange(6)))]
        else:
            parts = samples.mutate(rng.choice(good), rng)
        try:
            decode(parts)
        except CodecError:
            refused += 1
    assert refused > 8_000  # a flipped bit in a pixel cannot be seen; nearly all else can


@given(st.binary(max_size=300))
def test_a_payload_that_is_no_framed_message_is_refused(payload: bytes) -> None:
    try:
        parts = unpack_parts(payload)
    except CodecError:
        return
    assert all(isinstance(part, bytes) for part in parts)


@pytest.mark.parametrize("payload", [samples.deep_bomb(10**5), msgpack.packb([b""] * 9), msgpack.packb(["a"]), b"\xc0"])
def test_framing_bombs_are_refused(payload: bytes) -> None:
    with pytest.raises(CodecError):
        unpack_parts(payload)


def test_a_small_png_that_would_take_gigabytes_is_refused() -> None:
    parts = unpack_parts((Path(__file__).with_name("crashers") / "png-bomb.msg").read_bytes())
    with pytest.raises(CodecError, match=r"PNG image|bad header"):
        decode_as(PosedFrame, parts)
    with pytest.raises(CodecError, match="PNG image"):
        sniff_image(parts[2])
