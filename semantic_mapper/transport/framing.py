"""Multipart messages: their limits, and a message as one run of bytes, for logs.

In a log a message is a msgpack array of binaries, which any msgpack reader opens.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import msgpack

from semantic_mapper.errors import CodecError
from semantic_mapper.types import MAX_PIXELS

Buffer = bytes | bytearray | memoryview
Parts = Sequence[Buffer]

MAX_PARTS = 8
MAX_KEYFRAME_PIXELS = 1 << 23  # 4096 x 2048: dozens of them are kept while a finetuner learns
MAX_PART_BYTES = 4 * MAX_PIXELS + (1 << 16)  # one float32 image and some room for a codec's overhead


def pack_parts(parts: Parts) -> bytes:
    """Multipart message -> one payload."""
    return cast(bytes, msgpack.packb([bytes(p) if isinstance(p, memoryview) else p for p in parts], use_bin_type=True))


def unpack_parts(payload: Buffer) -> list[bytes]:
    """Inverse of ``pack_parts``.

    Raises:
        CodecError: not such a payload, or one beyond the size limits.
    """
    try:
        parts = msgpack.unpackb(
            payload,
            max_array_len=MAX_PARTS,
            max_bin_len=MAX_PART_BYTES,
            max_str_len=0,
            max_map_len=0,
            max_ext_len=0,
        )
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        raise CodecError(f"payload is not a framed message: {error or type(error).__name__}") from error
    if not isinstance(parts, list) or not all(isinstance(p, bytes) for p in cast("list[object]", parts)):
        raise CodecError("payload is not a framed message: expected an array of binaries")
    return cast("list[bytes]", parts)


def check_buffers(parts: Parts, sizes: Sequence[int], what: str) -> Parts:
    """The buffers of a message: all parts after topic and header.

    Raises:
        CodecError: they do not have the sizes that the header announces; names both.
    """
    actual = [len(p) for p in parts[2:]]
    if actual != list(sizes):
        raise CodecError(f"{what}: the header announces buffers of {list(sizes)} bytes, got {actual}")
    return parts[2:]
