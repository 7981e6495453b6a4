"""A multipart message as one run of bytes, for logs: a msgpack array of binaries, which any msgpack reader opens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import msgpack

from semantic_mapper.errors import CodecError
from semantic_mapper.types import MAX_PIXELS

Buffer = bytes | bytearray | memoryview

MAX_PARTS = 8
MAX_KEYFRAME_PIXELS = 1 << 23  # 4096 x 2048: dozens of them are kept while a finetuner learns
MAX_PART_BYTES = 4 * MAX_PIXELS + (1 << 16)  # one float32 image and some room for a codec's overhead


def pack_parts(parts: Sequence[Buffer]) -> bytes:
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
