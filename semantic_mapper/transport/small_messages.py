"""Codec of the messages that are all header: refusals, status, stream information, end of stream."""

from __future__ import annotations

import msgspec

from semantic_mapper.transport import headers
from semantic_mapper.transport.headers import MAX_DAMAGES, pack_header
from semantic_mapper.transport.messages import EndOfStream, FrameRefused, Status, StreamInfo
from semantic_mapper.transport.opening import Parts, check_source, message_name, open_plain
from semantic_mapper.transport.plain import intrinsics_header, label_set_header, to_intrinsics, to_label_set
from semantic_mapper.transport.topics import topic_bytes


def encode_refused(refused: FrameRefused) -> list[bytes]:
    """Refusal -> parts; an overlong reason is cut.

    Raises:
        CodecError: a value that cannot be sent.
    """
    header = headers.FrameRefusedHeader(
        stamp_ns=int(refused.stamp_ns), seq=int(refused.seq), camera_id=refused.camera_id, reason=refused.reason[:4096]
    )
    what = message_name("refused", refused.camera_id, refused.seq)
    return [topic_bytes("refused", refused.camera_id), pack_header(header, what)]


def decode_refused(parts: Parts) -> FrameRefused:
    """Parts -> refusal.

    Raises:
        CodecError: anything that ``encode_refused`` would not have made.
    """
    h = open_plain(parts, "refused", headers.FrameRefusedHeader)
    check_source(parts, h.camera_id)
    return FrameRefused(h.stamp_ns, h.seq, h.camera_id, h.reason)


def encode_status(status: Status) -> list[bytes]:
    """Status -> parts.

    Raises:
        CodecError: a value that cannot be sent.
    """
    header = headers.StatusHeader(
        node=status.node,
        state=status.state,
        stamp_ns=int(status.stamp_ns),
        counters={k: int(v) for k, v in status.counters.items()},
        ages_s={k: float(v) for k, v in status.ages_s.items()},
        degraded=tuple(text[:4096] for text in status.degraded),
    )
    return [topic_bytes("status", status.node), pack_header(header, f"status of '{status.node}'")]


def decode_status(parts: Parts) -> Status:
    """Parts -> status.

    Raises:
        CodecError: anything that ``encode_status`` would not have made.
    """
    h = open_plain(parts, "status", headers.StatusHeader)
    check_source(parts, h.node)
    return Status(h.node, h.state, h.stamp_ns, h.counters, h.ages_s, h.degraded)


def encode_info(info: StreamInfo, sender: str = "source") -> list[bytes]:
    """Stream info -> parts.

    Args:
        info: What is to come.
        sender: Second word of the topic.

    Raises:
        CodecError: a value that cannot be sent.
    """
    labels = info.label_set
    header = headers.StreamInfoHeader(
        source=info.source,
        cameras={name: intrinsics_header(i) for name, i in info.cameras.items()},
        label_set=None if labels is None else label_set_header(labels),
        frame_count=info.frame_count,
        frame_hz=float(info.frame_hz),
        metadata=dict(info.metadata),
    )
    return [topic_bytes("info", sender), pack_header(header, f"stream info of '{info.source}'")]


def decode_info(parts: Parts) -> StreamInfo:
    """Parts -> stream info.

    Raises:
        CodecError: anything that ``encode_info`` would not have made.
    """
    h = open_plain(parts, "info", headers.StreamInfoHeader)
    return StreamInfo(
        source=h.source,
        cameras={name: to_intrinsics(i, f"camera '{name}'") for name, i in h.cameras.items()},
        label_set=None if h.label_set is None else to_label_set(h.label_set),
        frame_count=h.frame_count,
        frame_hz=h.frame_hz,
        metadata=h.metadata,
    )


def encode_end(end: EndOfStream) -> list[bytes]:
    """End of stream -> parts.

    Raises:
        CodecError: a value that cannot be sent.
    """
    header = headers.EndOfStreamHeader(
        source=end.source,
        reason=end.reason,
        published=int(end.published),
        detail=end.detail[:4096],
        damages=tuple(text[:1024] for text in end.damages[:MAX_DAMAGES]),
        unreadable=int(end.unreadable) or msgspec.UNSET,
    )
    return [topic_bytes("end", end.source), pack_header(header, f"end of '{end.source}'")]


def decode_end(parts: Parts) -> EndOfStream:
    """Parts -> end of stream.

    Raises:
        CodecError: anything that ``encode_end`` would not have made.
    """
    h = open_plain(parts, "end", headers.EndOfStreamHeader)
    check_source(parts, h.source)
    return EndOfStream(h.source, h.reason, h.published, h.detail, h.damages, h.unreadable or 0)
