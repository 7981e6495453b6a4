"""Questions and answers as bytes: exact round trips, and an error for whatever is none."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.errors import CodecError, LabelError, MapError, TransportError, WeightsError
from semantic_mapper.transport import query_messages as messages
from semantic_mapper.transport.codec import decode_answer, decode_request, encode_answer, encode_error, encode_request

ABOUT = {"map_id": "m", "version": 7, "epoch": 1}
POINTS = np.random.default_rng(3).normal(size=(5, 3))


def at_request(points: np.ndarray = POINTS) -> list[bytes]:
    return encode_request("at", messages.AtRequest(points=points, radius_m=0.1))


def with_header(parts: list[bytes], **changes: object) -> list[bytes]:
    header = {**msgpack.unpackb(parts[1]), **changes}
    return [parts[0], msgpack.packb(header), *parts[2:]]


def test_a_question_arrives_as_it_was_asked() -> None:
    kind, request = decode_request(at_request(POINTS[::2]))
    assert kind == "at" and isinstance(request, messages.AtRequest) and request.radius_m == 0.1
    np.testing.assert_array_equal(request.points, POINTS[::2])
    request.points[0] = 0  # its own memory
    kind, request = decode_request(at_request(np.empty((0, 3))))
    assert isinstance(request, messages.AtRequest) and request.points.shape == (0, 3)


def test_an_answer_arrives_as_it_was_given(rng: np.random.Generator) -> None:
    given = {
        "keys": rng.integers(-9, 9, (4, 3), np.int32),
        "tsdf": rng.integers(-128, 127, (4, 512), np.int8),
        "label": rng.integers(0, 255, (4, 512), np.uint8),
        "confidence": np.zeros((4, 512), np.uint8),
        "rgb": rng.integers(0, 255, (4, 512, 3), np.uint8),
    }
    parts = encode_answer("changes", messages.ChangesAnswer(**ABOUT, since=3, newest=9, **given))
    answer = decode_answer("changes", messages.ChangesAnswer, parts)
    assert (answer.map_id, answer.since, answer.version, answer.epoch, answer.newest) == ("m", 3, 7, 1, 9)
    for name, values in given.items():
        np.testing.assert_array_equal(getattr(answer, name), values)
        assert getattr(answer, name).dtype == values.dtype
    far = np.array([np.inf, 1.5], np.float32)
    found = {"label": np.ones(2), "confidence": np.ones(2), "distance_m": far, "state": np.ones(2)}
    parts = encode_answer("at", messages.AtAnswer(**ABOUT, **found))
    np.testing.assert_array_equal(decode_answer("at", messages.AtAnswer, parts).distance_m, far)


@pytest.mark.parametrize("error", [MapError("the box is empty"), LabelError("no class"), CodecError("é" * 9000)])
def test_an_error_is_raised_on_the_other_side(error: Exception) -> None:
    with pytest.raises(type(error), match=str(error)[:100]):
        decode_answer("at", messages.AtAnswer, encode_error(error))  # type: ignore[arg-type]
    with pytest.raises(TransportError, match="no weights"):  # one that no query raises
        decode_answer("at", messages.AtAnswer, encode_error(WeightsError("no weights")))


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ([], "2 to 8 parts"),
        ([b"at"], "2 to 8 parts"),
        ([b"at"] * 9, "2 to 8 parts"),
        ([b"kill", b""], "unknown question"),
        ([b"at" * 100, b""], "unknown question"),
        ([b"at", b"\xc1"], "bad header"),
        (at_request()[:2], "announces buffers"),
        ([*at_request(), b""], "announces buffers"),
        (with_header(at_request(), v=2), "protocol version 2"),
        (with_header(at_request(), radius_m="far"), "bad header"),
        (with_header(at_request(), radius_m=float("nan")), "only finite"),
        (with_header(at_request(), extra=1), "bad header"),
        (with_header(at_request(), arrays=[]), "has the arrays"),
        (with_header(at_request(), arrays=[{"shape": [5], "bytes": 120}]), "expected"),
        (with_header(at_request(), arrays=[{"shape": [5, 2], "bytes": 120}]), "expected"),
        (with_header(at_request(), arrays=[{"shape": [1 << 31, 3], "bytes": 120}]), "are accepted"),
        (with_header(at_request(), arrays=[{"shape": [1 << 20, 3], "bytes": 24 << 20}]), "at most 65536 at once"),
        (with_header(at_request(), arrays=[{"shape": [6, 3], "bytes": 120}]), "has 144 bytes"),
        (with_header(at_request(), arrays=[{"shape": [-5, 3], "bytes": 120}]), "bad header"),
    ],
)
def test_what_is_no_question_is_refused(parts: list[bytes], says: str) -> None:
    with pytest.raises(CodecError, match=says):
        decode_request(parts)


def test_answers_are_bounded_before_anything_is_decompressed() -> None:
    gives = {"state": np.zeros((4, 4, 4), np.uint8), "distance_m": np.zeros((4, 4, 4), np.float32)}
    header = messages.DistanceAnswer(**ABOUT, origin_m=(0.0, 0.0, 0.0), voxel_size_m=0.1, **gives)
    parts = encode_answer("distance_field", header)
    specs = msgpack.unpackb(parts[1])["arrays"]
    for shape, says in (([1 << 11] * 3, "are accepted"), ([4, 4, 5], "different lengths"), ([4, 16], "expected")):
        bad = with_header(parts, arrays=[specs[0], {**specs[1], "shape": shape}])
        with pytest.raises(CodecError, match=says):
            decode_answer("distance_field", messages.DistanceAnswer, bad)
    both = [{**specs[0], "shape": [4, 4, 8], "bytes": 512}, {**specs[1], "shape": [4, 4, 8]}]
    with pytest.raises(CodecError, match="announce 64 bytes, the header means 128"):
        decode_answer(
            "distance_field", messages.DistanceAnswer, [*with_header(parts, arrays=both)[:2], bytes(512), parts[3]]
        )
    with pytest.raises(CodecError, match="got one to 'distance_field'"):
        decode_answer("at", messages.AtAnswer, parts)


@given(st.data())
def test_no_mutation_of_a_question_raises_anything_but_codec_errors(data: st.DataObject) -> None:
    parts = [bytearray(p) for p in at_request()]
    for _ in range(data.draw(st.integers(1, 4))):
        part = data.draw(st.sampled_from(parts))
        at = data.draw(st.integers(0, len(part)))
        part[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    try:
        _, request = decode_request(parts)
    except CodecError:
        return
    assert isinstance(request, messages.AtRequest) and request.points.ndim == 2 and request.points.shape[1] == 3
