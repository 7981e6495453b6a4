"""Codec of questions and answers: multipart ``[kind, msgpack header, raw buffers...]``, bounded like all messages.

Everything here raises nothing but ``CodecError``, but for ``decode_answer``, which raises what the answer says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper import errors
from semantic_mapper.errors import CodecError, SemanticMapperError, TransportError
from semantic_mapper.transport.compression import zstd_compress, zstd_decompress
from semantic_mapper.transport.framing import MAX_PART_BYTES, MAX_PARTS, Buffer
from semantic_mapper.transport.headers import pack_header, unpack_header
from semantic_mapper.transport.opening import Parts, open_buffers
from semantic_mapper.transport.query_messages import (
    MAX_REQUEST_ROWS,
    QUESTIONS,
    AnswerHeader,
    ArrayForm,
    ArraySpec,
    ErrorAnswer,
    RequestHeader,
)

Arrays = dict[str, NDArray[np.generic]]
ERROR = b"error"
_ZSTD_LEVEL = 1
_RAISED = {
    e.__name__: e for e in (errors.MapError, errors.LabelError, errors.CodecError, errors.ShapeError, errors.PoseError)
}

RequestT = TypeVar("RequestT", bound=RequestHeader)
AnswerT = TypeVar("AnswerT", bound=AnswerHeader)


def encode_request(kind: str, header: RequestHeader, arrays: Mapping[str, NDArray[np.generic]]) -> list[bytes]:
    """Question -> parts.

    Args:
        kind: A key of ``QUESTIONS``.
        header: Of its request type; ``arrays`` of it are filled in here.
        arrays: Those that it takes; converted to its dtypes.

    Raises:
        CodecError: too many rows, or a value that cannot be sent.
    """
    specs, buffers = _pack(QUESTIONS[kind].takes, arrays, kind)
    _check_rows(specs, kind)
    return [kind.encode(), pack_header(msgspec.structs.replace(header, arrays=specs), kind), *buffers]


def decode_request(parts: Parts) -> tuple[str, RequestHeader, Arrays]:
    """Parts -> kind, header, arrays.

    Raises:
        CodecError: anything that ``encode_request`` would not have made.
    """
    kind = _kind(parts)
    question = QUESTIONS.get(kind)
    if question is None:
        raise CodecError(f"question {kind!r} is none of ours; there are {', '.join(QUESTIONS)}")
    header = unpack_header(parts[1], question.request, kind)
    _check_specs(question.takes, header.arrays, kind)
    _check_rows(header.arrays, kind)
    return kind, header, _unpack(question.takes, header.arrays, parts, kind)


def encode_answer(kind: str, header: AnswerHeader, arrays: Mapping[str, NDArray[np.generic]]) -> list[bytes]:
    """Answer -> parts; see ``encode_request``.

    Raises:
        CodecError: larger than a message may be, or a value that cannot be sent.
    """
    specs, buffers = _pack(QUESTIONS[kind].gives, arrays, f"answer to '{kind}'")
    header = msgspec.structs.replace(header, arrays=specs)
    return [kind.encode(), pack_header(header, f"answer to '{kind}'"), *buffers]


def encode_error(error: SemanticMapperError) -> list[bytes]:
    """An error in the place of an answer; an overlong text is cut."""
    text = str(error).encode("utf-8", errors="replace").decode()[:4000]
    return [ERROR, pack_header(ErrorAnswer(error=type(error).__name__, text=text), "error")]


def decode_answer(kind: str, header_type: type[AnswerT], parts: Parts) -> tuple[AnswerT, Arrays]:
    """Parts -> header and arrays of the answer to a question.

    Args:
        kind: Of the question.
        header_type: The answer type of the question.
        parts: What came.

    Raises:
        MapError, LabelError, CodecError, ShapeError, PoseError: the other side answered with this error.
        TransportError: it answered with another one.
        CodecError: anything that ``encode_answer`` would not have made, or an answer to another question.
    """
    what = f"answer to '{kind}'"
    actual = _kind(parts)
    if actual == ERROR.decode():
        said = unpack_header(parts[1], ErrorAnswer, what)
        raise _RAISED.get(said.error, TransportError)(said.text)
    if actual != kind:
        raise CodecError(f"{what}: got one to {actual!r}")
    header = unpack_header(parts[1], header_type, what)
    question = QUESTIONS[kind]
    _check_specs(question.gives, header.arrays, what)
    free = {spec.shape[: form.free] for form, spec in zip(question.gives.values(), header.arrays, strict=True)}
    if question.aligned and len(free) > 1:
        raise CodecError(f"{what}: arrays of different lengths {sorted(free)}")
    return header, _unpack(question.gives, header.arrays, parts, what)


def _kind(parts: Parts) -> str:
    if not 2 <= len(parts) <= MAX_PARTS:
        raise CodecError(f"a question or answer has 2 to {MAX_PARTS} parts, got {len(parts)}")
    return bytes(parts[0][:32]).decode("ascii", errors="replace")


def _check_rows(specs: tuple[ArraySpec, ...], what: str) -> None:
    for spec in specs:
        if spec.shape[0] > MAX_REQUEST_ROWS:
            raise CodecError(f"{what}: {spec.shape[0]} rows; ask for at most {MAX_REQUEST_ROWS} at once")


def _check_specs(forms: Mapping[str, ArrayForm], specs: tuple[ArraySpec, ...], what: str) -> None:
    if len(specs) != len(forms):
        raise CodecError(f"{what}: has the arrays {list(forms)}, got {len(specs)}")
    for (name, form), spec in zip(forms.items(), specs, strict=True):
        if len(spec.shape) != form.free + len(form.tail) or spec.shape[form.free :] != form.tail:
            raise CodecError(f"{what}: {name} of shape {spec.shape}, expected {('N',) * form.free + form.tail}")
        size = math.prod(spec.shape) * np.dtype(form.dtype).itemsize
        if size > MAX_PART_BYTES:
            raise CodecError(f"{what}: {name} of {size} bytes, at most {MAX_PART_BYTES} are accepted; ask for less")
        if not _is_compressed(form) and spec.bytes != size:
            raise CodecError(f"{what}: {name} of shape {spec.shape} has {size} bytes, the header means {spec.bytes}")


def _pack(
    forms: Mapping[str, ArrayForm], arrays: Mapping[str, NDArray[np.generic]], what: str
) -> tuple[tuple[ArraySpec, ...], list[bytes]]:
    specs: list[ArraySpec] = []
    buffers: list[bytes] = []
    for name, form in forms.items():
        array = np.ascontiguousarray(arrays[name], form.dtype)
        if array.nbytes > MAX_PART_BYTES:  # before it is copied; the rest is checked when all are there
            raise CodecError(f"{what}: {name} of {array.nbytes} bytes, at most {MAX_PART_BYTES} can be sent")
        data = array.tobytes()
        buffers.append(zstd_compress(data, _ZSTD_LEVEL) if _is_compressed(form) else data)
        specs.append(ArraySpec(shape=array.shape, bytes=len(buffers[-1])))
    _check_specs(forms, tuple(specs), what)
    return tuple(specs), buffers


def _unpack(forms: Mapping[str, ArrayForm], specs: tuple[ArraySpec, ...], parts: Parts, what: str) -> Arrays:
    """Fresh and writable arrays; their sizes were checked by ``_check_specs``."""
    buffers = open_buffers(parts, [spec.bytes for spec in specs], what)
    arrays: Arrays = {}
    for (name, form), spec, buffer in zip(forms.items(), specs, buffers, strict=True):
        data: Buffer = buffer
        if _is_compressed(form):
            data = zstd_decompress(buffer, math.prod(spec.shape), f"{what}: {name}")
        array = np.frombuffer(data, form.dtype).reshape(spec.shape)
        arrays[name] = array.astype(np.dtype(form.dtype).newbyteorder("="))
    return arrays


def _is_compressed(form: ArrayForm) -> bool:
    return np.dtype(form.dtype).itemsize == 1
