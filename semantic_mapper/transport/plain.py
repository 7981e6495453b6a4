"""Core types <-> the structs that travel in headers."""

from __future__ import annotations

from semantic_mapper.errors import CodecError, FrameError, LabelError
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport import headers
from semantic_mapper.types import CameraIntrinsics


def intrinsics_header(i: CameraIntrinsics) -> headers.IntrinsicsHeader:
    """Intrinsics as they travel."""
    return headers.IntrinsicsHeader(
        fx=float(i.fx),
        fy=float(i.fy),
        cx=float(i.cx),
        cy=float(i.cy),
        width=int(i.width),
        height=int(i.height),
        distortion=tuple(float(d) for d in i.distortion),
    )


def to_intrinsics(h: headers.IntrinsicsHeader, what: str) -> CameraIntrinsics:
    """Inverse of ``intrinsics_header``.

    Raises:
        CodecError: they do not fit the image; see ``CameraIntrinsics``.
    """
    try:
        return CameraIntrinsics(h.fx, h.fy, h.cx, h.cy, h.width, h.height, h.distortion)
    except FrameError as error:
        raise CodecError(f"{what}: {error}") from error


def label_set_header(labels: LabelSet) -> headers.LabelSetHeader:
    """Label set as it travels."""
    classes = tuple(
        headers.ClassHeader(id=i, name=name, color=color)
        for i, name, color in zip(labels.ids, labels.names, labels.colors, strict=True)
    )
    return headers.LabelSetHeader(name=labels.name, classes=classes, ignore_id=labels.ignore_id)


def to_label_set(h: headers.LabelSetHeader) -> LabelSet:
    """Inverse of ``label_set_header``.

    Raises:
        CodecError: a class or id twice, or a class that is the ignore id.
    """
    try:
        return LabelSet(
            h.name,
            tuple(c.id for c in h.classes),
            tuple(c.name for c in h.classes),
            tuple(c.color for c in h.classes),
            h.ignore_id,
        )
    except LabelError as error:
        raise CodecError(f"stream info: {error}") from error
