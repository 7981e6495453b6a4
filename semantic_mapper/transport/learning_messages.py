"""Codec of what a learner and a mapper tell each other: weights that are offered, and those that are in use."""

from __future__ import annotations

import hashlib

from semantic_mapper.errors import CodecError
from semantic_mapper.transport import headers
from semantic_mapper.transport.framing import Buffer
from semantic_mapper.transport.headers import MAX_WEIGHTS_BYTES, pack_header
from semantic_mapper.transport.messages import WeightsInUse, WeightsUpdate
from semantic_mapper.transport.opening import Parts, check_source, open_buffers, open_header, open_plain
from semantic_mapper.transport.topics import topic_bytes


def encode_weights(update: WeightsUpdate) -> list[bytes]:
    """Weights -> parts.

    Raises:
        CodecError: a value that cannot be sent, or a file of more than ``MAX_WEIGHTS_BYTES``.
    """
    what = _name(update.node, update.version)
    if len(update.data) > MAX_WEIGHTS_BYTES:
        raise CodecError(f"{what}: a file of {len(update.data)} bytes; at most {MAX_WEIGHTS_BYTES} can be sent")
    header = headers.WeightsHeader(
        node=update.node,
        version=int(update.version),
        bytes=len(update.data),
        digest=update.digest,
        parent=update.parent,
        score=float(update.score),
        parent_score=float(update.parent_score),
        keyframes=int(update.keyframes),
        held_out=int(update.held_out),
    )
    return [topic_bytes("weights", update.node), pack_header(header, what), update.data]


def decode_weights(parts: Parts) -> WeightsUpdate:
    """Parts -> weights, not a bit of the file another one.

    Raises:
        CodecError: anything that ``encode_weights`` would not have made.
    """
    h, data = open_weights(parts)
    if digest_of(data) != h.digest:
        raise CodecError(f"{_name(h.node, h.version)}: the file is not the one that its digest names")
    return WeightsUpdate(
        node=h.node,
        version=h.version,
        data=bytes(data),
        digest=h.digest,
        parent=h.parent,
        score=h.score,
        parent_score=h.parent_score,
        keyframes=h.keyframes,
        held_out=h.held_out,
    )


def open_weights(parts: Parts) -> tuple[headers.WeightsHeader, Buffer]:
    """Header and file of weights, of which only the size is checked.

    Raises:
        CodecError: a bad header, or another size.
    """
    h = open_header(parts, "weights", headers.WeightsHeader)
    check_source(parts, h.node)
    (data,) = open_buffers(parts, [h.bytes], _name(h.node, h.version))
    return h, data


def digest_of(data: Buffer) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def encode_in_use(in_use: WeightsInUse) -> list[bytes]:
    """Weights in use -> parts; an overlong reason is cut.

    Raises:
        CodecError: a value that cannot be sent.
    """
    header = headers.WeightsInUseHeader(
        node=in_use.node,
        version=int(in_use.version),
        digest=in_use.digest,
        newest=int(in_use.newest),
        judged=int(in_use.judged),
        accepted=bool(in_use.accepted),
        reason=in_use.reason[:4096],
        rolled_back=int(in_use.rolled_back),
        contradicts=bool(in_use.contradicts),
    )
    return [topic_bytes("in_use", in_use.node), pack_header(header, f"weights in use at '{in_use.node}'")]


def decode_in_use(parts: Parts) -> WeightsInUse:
    """Parts -> weights in use.

    Raises:
        CodecError: anything that ``encode_in_use`` would not have made.
    """
    h = open_plain(parts, "in_use", headers.WeightsInUseHeader)
    check_source(parts, h.node)
    return WeightsInUse(
        h.node, h.version, h.digest, h.newest, h.judged, h.accepted, h.reason, h.rolled_back, h.contradicts
    )


def _name(node: str, version: int) -> str:
    return f"weights {version} of '{node}'"
