"""Questions about a map and their answers as bytes: three parts, ``[name, msgpack header, arrays]``.

A question is a struct of fields; an answer is any struct or frozen dataclass, as the library's own results are. Where
one of them has an array, its header says ``{dtype, shape, start, bytes}``: its elements, little-endian and row by row,
lie in the third part from ``start`` on. Arrays of single bytes are zstd frames there.

Header of a question: its fields. Of an answer: ``map`` (``MapState``) and ``answer``. In the place of an answer may
come an error, ``["error", header]``. Every size is checked before anything is allocated by it, and whatever is wrong is
a ``CodecError``.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from semantic_mapper import errors
from semantic_mapper.errors import CodecError, SemanticMapperError, TransportError
from semantic_mapper.transport.codec import check_header, pack_header, unpack_header
from semantic_mapper.transport.images import zstd_compress, zstd_decompress
from semantic_mapper.transport.messages import MAX_PART_BYTES, Count, PartBytes, Parts, Sentence, Wire, Word

MAX_REQUEST_ROWS = 1 << 16  # points, rays or poses of one question
MAX_WAIT_S = 3600.0  # for an answer, of a client that does not say

AnswerT = TypeVar("AnswerT")
RequestT = TypeVar("RequestT", bound="Request[Any]")

_ERROR = "error"  # in the place of an answer's name
_RAISED = {
    e.__name__: e for e in (errors.MapError, errors.LabelError, errors.CodecError, errors.ShapeError, errors.PoseError)
}


class Request(Wire, Generic[AnswerT], frozen=True, kw_only=True):
    """What every question has; ``AnswerT`` is what answers it.

    ``asker`` is the same for all questions of a client that awaits each answer, through whichever socket; empty = not
    known. Nobody waits for the answer after ``waits_s``.
    """

    takes_long: ClassVar[bool] = False  # more than a few milliseconds
    about_map: ClassVar[bool] = True  # answered from a snapshot, which has to be up to date

    asker: Word = ""
    waits_s: Annotated[float, Meta(ge=0, le=MAX_WAIT_S)] = MAX_WAIT_S


class MapState(Wire, frozen=True):
    """Which state of which map an answer is about.

    ``map_id`` is another one after the mapper was restarted; versions of two maps cannot be compared.
    """

    map_id: Word
    version: Count
    epoch: Count


class _ArraySpec(Wire, frozen=True):
    dtype: Literal["|b1", "|u1", "|i1", "<i4", "<i8", "<f4", "<f8"]
    shape: Annotated[tuple[Annotated[int, Meta(ge=0, le=1 << 31)], ...], Meta(min_length=1, max_length=4)]
    start: PartBytes
    bytes: PartBytes


class _ErrorHeader(Wire, frozen=True):
    """The name of an error class of ours, and what it says."""

    error: Word
    text: Sentence


def encode_request(name: str, request: Request[Any]) -> list[bytes]:
    """Question -> parts; arrays are converted to the dtypes of their fields.

    Raises:
        CodecError: too many rows, or a value that cannot be sent.
    """
    parts = _encode(name, {}, request, name)
    decode_request(parts, type(request))  # as its reader will
    return parts


def read_name(parts: Parts) -> str:
    """The name of a question or answer.

    Raises:
        CodecError: it is neither.
    """
    if not 2 <= len(parts) <= 3:
        raise CodecError(f"a question or answer has 2 or 3 parts, got {len(parts)}")
    return bytes(parts[0][:32]).decode("ascii", errors="replace")


def decode_request(parts: Parts, kind: type[RequestT]) -> RequestT:
    """Parts -> question; its arrays are fresh and writable.

    Raises:
        CodecError: anything that ``encode_request`` would not have made.
    """
    name = read_name(parts)
    return _convert(unpack_header(parts[1], name), kind, parts, name, MAX_REQUEST_ROWS)


def encode_answer(name: str, state: MapState, answer: object) -> list[bytes]:
    """Answer -> parts.

    Raises:
        CodecError: larger than a message may be, or a value that cannot be sent.
    """
    return _encode(name, {"map": msgspec.to_builtins(state)}, answer, f"answer to '{name}'")


def encode_error(error: SemanticMapperError) -> list[bytes]:
    """An error in the place of an answer; an overlong text is cut."""
    text = str(error).encode("utf-8", errors="replace").decode()[:4000]
    return [_ERROR.encode(), pack_header({"error": type(error).__name__, "text": text}, "error")]


def decode_answer(name: str, kind: type[AnswerT], parts: Parts) -> tuple[MapState, AnswerT]:
    """Parts -> what the answer is about, and the answer; its arrays are fresh and writable.

    Args:
        name: Of the question.
        kind: Type of the answer.
        parts: What came.

    Raises:
        MapError, LabelError, CodecError, ShapeError, PoseError: the other side answered with this error.
        TransportError: it answered with another one.
        CodecError: anything that ``encode_answer`` would not have made, or an answer to another question.
    """
    what = f"answer to '{name}'"
    actual = read_name(parts)
    header = unpack_header(parts[1], what)
    if actual == _ERROR:
        reported = check_header(header, _ErrorHeader, what)
        raise _RAISED.get(reported.error, TransportError)(reported.text)
    if actual != name:
        raise CodecError(f"{what}: got one to {actual!r}")
    if header.keys() != {"map", "answer"}:
        raise CodecError(f"{what}: bad header: expected `map` and `answer`, got {', '.join(header)}")
    state = check_header(header["map"], MapState, what)
    return state, _convert(header["answer"], kind, parts, what)


def _encode(name: str, about: dict[str, Any], message: object, what: str) -> list[bytes]:
    buffers: list[bytes] = []
    size = 0

    def pack(value: object) -> object:
        nonlocal size
        if isinstance(value, np.generic):
            return value.item()
        if not isinstance(value, np.ndarray):
            raise TypeError(f"no header holds a {type(value).__name__}")
        array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        if array.nbytes > MAX_PART_BYTES:  # before it is copied
            raise CodecError(f"{what}: an array of {array.nbytes} bytes, at most {MAX_PART_BYTES} can be sent")
        data = array.tobytes()
        if array.itemsize == 1:
            data = zstd_compress(data)
        spec = {"dtype": array.dtype.str, "shape": value.shape, "start": size, "bytes": len(data)}
        buffers.append(data)
        size += len(data)
        return spec

    try:
        plain = msgspec.to_builtins(message, enc_hook=pack)
    except CodecError:
        raise
    except (ValueError, TypeError, OverflowError) as error:
        raise CodecError(f"{what}: cannot be sent: {error}") from error
    if size > MAX_PART_BYTES:
        raise CodecError(f"{what}: arrays of {size} bytes, at most {MAX_PART_BYTES} can be sent; ask for less")
    header = pack_header({**about, "answer": plain} if about else plain, what)
    return [name.encode(), header, *([b"".join(buffers)] if buffers else [])]


def _convert(header: object, kind: type[AnswerT], parts: Parts, what: str, max_rows: int = 1 << 31) -> AnswerT:
    blob = memoryview(parts[2]) if len(parts) > 2 else memoryview(b"")

    def unpack(annotation: Any, value: object) -> NDArray[np.generic]:
        wanted = np.dtype(get_args(get_args(annotation)[1])[0])  # of NDArray[...]
        spec = msgspec.convert(value, _ArraySpec)
        if np.dtype(spec.dtype) != wanted:
            raise CodecError(f"expected an array of {wanted.name}, got {np.dtype(spec.dtype).name}")
        if spec.shape and spec.shape[0] > max_rows:
            raise CodecError(f"{spec.shape[0]} rows; ask for at most {max_rows} at once")
        size = math.prod(spec.shape) * wanted.itemsize
        if size > MAX_PART_BYTES:
            raise CodecError(f"an array of {size} bytes, at most {MAX_PART_BYTES} are accepted; ask for less")
        data = blob[spec.start : spec.start + spec.bytes]
        if wanted.itemsize == 1:
            data = zstd_decompress(data, size, "an array")
        if len(data) != size:
            raise CodecError(f"an array of shape {spec.shape} has {size} bytes, got {len(data)}")
        if wanted == np.bool_:
            return np.frombuffer(data, np.uint8).reshape(spec.shape) != 0
        return np.frombuffer(data, spec.dtype).reshape(spec.shape).astype(wanted)

    return check_header(header, kind, what, unpack)
