"""Questions and answers as bytes: exact round trips, and an error for anything else."""

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.errors import CodecError
from semantic_mapper.queries.nearest import PointAnswers
from semantic_mapper.queries.questions import (
    AtRequest,
    MapState,
    decode_answer,
    decode_question,
    encode_answer,
    encode_request,
)
from semantic_mapper.types import UInt8

from .samples import with_header

STATE = MapState("m", 7, 1)
POINTS = np.random.default_rng(3).normal(size=(5, 3))


def at_request() -> list[bytes]:
    return encode_request("at", AtRequest(points=POINTS, radius_m=0.1))


def with_points(**changes: object) -> list[bytes]:
    """A question whose array is said to be otherwise."""
    spec = msgpack.unpackb(at_request()[1])["points"]
    return with_header(at_request(), points={**spec, **changes})


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ([], "2 or 3 parts"),
        ([b"at"], "2 or 3 parts"),
        ([b"at"] * 4, "2 or 3 parts"),
        ([b"kill" * 100, b""], "unknown question"),
        ([b"at", b"\xc1"], "bad header"),
        (at_request()[:2], "has 120 bytes, got 0"),
        (with_header(at_request(), v=2), "protocol version 2"),
        (with_header(at_request(), radius_m="far"), "bad header"),
        (with_header(at_request(), radius_m=float("nan")), "only finite"),
        (with_header(at_request(), extra=1), "bad header"),
        (with_header(at_request(), points=[1.0, 2.0]), "bad header"),
        (with_points(dtype="<f4"), "expected an array of float64, got float32"),
        (with_points(dtype="O"), "bad header"),
        (with_points(shape=[1 << 16, 1 << 31]), "are accepted"),
        (with_points(shape=[1 << 20, 3]), "at most 65536 at once"),
        (with_points(shape=[6, 3]), "has 144 bytes, got 120"),
        (with_points(shape=[-5, 3]), "bad header"),
        (with_points(start=64), "has 120 bytes, got 56"),
    ],
)
def test_what_is_no_question_is_refused(parts: list[bytes], says: str) -> None:
    with pytest.raises(CodecError, match=says):
        decode_question(parts)


def test_what_is_no_answer_is_refused() -> None:
    parts = encode_answer("occupancy", STATE, np.zeros(4, np.uint8))
    spec = msgpack.unpackb(parts[1])["answer"]
    for changes, says in (({"shape": [1 << 29]}, "are accepted"), ({"shape": [8]}, "announce 4 bytes")):
        bad = with_header(parts, answer={**spec, **changes})
        with pytest.raises(CodecError, match=says):  # before anything is decompressed
            decode_answer("occupancy", UInt8, bad)
    with pytest.raises(CodecError, match="got one to 'occupancy'"):
        decode_answer("at", PointAnswers, parts)


@given(st.data())
def test_no_mutation_of_a_question_raises_anything_but_codec_errors(data: st.DataObject) -> None:
    parts = [bytearray(p) for p in at_request()]
    for _ in range(data.draw(st.integers(1, 4))):
        part = data.draw(st.sampled_from(parts))
        at = data.draw(st.integers(0, len(part)))
        part[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    try:
        request = decode_question(parts)
    except CodecError:
        return
    assert isinstance(request, AtRequest) and request.points.ndim > 0
