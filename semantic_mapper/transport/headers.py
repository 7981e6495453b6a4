"""Headers: msgpack maps, bounded before they are unpacked and checked field by field; the types of their fields."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar, cast

import msgpack
import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.errors import CodecError, FrameError
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.framing import MAX_PART_BYTES, Buffer
from semantic_mapper.types import MAX_SIDE, MAX_STAMP_NS, CameraIntrinsics

PROTOCOL_VERSION = 1  # raise it when a header changes its meaning; readers refuse what they do not know
MAX_HEADER_BYTES = 1 << 18
MAX_ENTRIES = 1024  # of one list in a header

SOURCE_PATTERN = r"^[A-Za-z0-9_.:-]{1,64}\Z"  # camera ids and node names, as they stand in topics
Source = Annotated[str, Meta(pattern=SOURCE_PATTERN)]
Stamp = Annotated[int, Meta(ge=0, le=2**63 - 1)]
CaptureStamp = Annotated[int, Meta(ge=0, le=MAX_STAMP_NS)]
MAX_COUNT = 2**63 - 1
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
PartBytes = Annotated[int, Meta(ge=0, le=MAX_PART_BYTES)]
Word = Annotated[str, Meta(max_length=128)]
Sentence = Annotated[str, Meta(max_length=4096)]
ClassId = Annotated[int, Meta(ge=0, le=255)]
Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]  # SHA-256
# Every number of a header is of this type or has bounds of its own: NaN and infinity are refused by comparison.
Finite = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
_BEYOND = re.compile(r"Expected `float` [<>]= \S+e\+308")  # how msgspec says it
UnitInterval = Annotated[float, Meta(ge=0, le=1)]


class Wire(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all structs that travel."""


class IntrinsicsForm(Wire, frozen=True):
    """``CameraIntrinsics`` in a header."""

    fx: Finite
    fy: Finite
    cx: Finite
    cy: Finite
    width: Side
    height: Side
    distortion: Annotated[tuple[Finite, ...], Meta(max_length=14)] = ()

    def to_intrinsics(self, what: str = "") -> CameraIntrinsics:
        """The core type.

        Args:
            what: Begins the error.

        Raises:
            FrameError: they do not fit the image; see ``CameraIntrinsics``.
        """
        try:
            return CameraIntrinsics(self.fx, self.fy, self.cx, self.cy, self.width, self.height, self.distortion)
        except FrameError as error:
            raise FrameError(f"{what}{error}") from error


class ClassForm(Wire, frozen=True):
    """One class of a label set."""

    id: ClassId
    name: Word
    color: tuple[ClassId, ClassId, ClassId]


class LabelSetForm(Wire, frozen=True):
    """``LabelSet`` in a header."""

    name: Word
    classes: Annotated[tuple[ClassForm, ...], Meta(min_length=1, max_length=256)]
    ignore_id: ClassId

    @classmethod
    def of(cls, labels: LabelSet) -> LabelSetForm:
        """A label set as it travels."""
        classes = tuple(map(ClassForm, labels.ids, labels.names, labels.colors))
        return cls(labels.name, classes, labels.ignore_id)

    def to_label_set(self) -> LabelSet:
        """The core type.

        Raises:
            LabelError: a class or id twice, or a class that is the ignore id.
        """
        ids, names, colors = zip(*((c.id, c.name, c.color) for c in self.classes), strict=True)
        return LabelSet(self.name, ids, names, colors, self.ignore_id)


WireT = TypeVar("WireT")


def to_plain(value: object, what: str) -> Any:
    """A message or header as dicts, lists, strings and numbers; numbers of NumPy become Python's.

    Raises:
        CodecError: it holds something else.
    """
    try:
        return msgspec.to_builtins(value, builtin_types=(bytes,), enc_hook=_plain_number)
    except (ValueError, TypeError, OverflowError) as error:
        raise CodecError(f"{what}: cannot be sent: {error}") from error


def pack_header(header: Mapping[str, Any], what: str) -> bytes:
    """Plain fields, which have passed ``check_header``, -> msgpack.

    Raises:
        CodecError: longer than ``MAX_HEADER_BYTES``.
    """
    packed = cast(bytes, msgpack.packb({"v": PROTOCOL_VERSION, **header}, use_bin_type=True))
    if len(packed) > MAX_HEADER_BYTES:
        raise CodecError(f"{what}: cannot be sent: a header of {len(packed)} bytes, at most {MAX_HEADER_BYTES}")
    return packed


def unpack_header(packed: Buffer, what: str) -> dict[str, Any]:
    """msgpack -> plain fields without the protocol's version, not checked any further.

    Raises:
        CodecError: too long, not msgpack, nested too deeply, no map, or of another protocol version.
    """
    if len(packed) > MAX_HEADER_BYTES:
        raise CodecError(f"{what}: header of {len(packed)} bytes, at most {MAX_HEADER_BYTES} are accepted")
    try:
        header: Any = msgpack.unpackb(
            packed, max_str_len=1 << 14, max_bin_len=0, max_array_len=MAX_ENTRIES, max_map_len=256, max_ext_len=0
        )
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        # ValueError includes msgpack's StackError and FormatError, and bad UTF-8.
        raise CodecError(f"{what}: bad header: {error or type(error).__name__}") from error
    if not isinstance(header, dict):
        raise CodecError(f"{what}: header must be a map, got {type(header).__name__}")
    fields = cast("dict[str, Any]", header)
    version = fields.pop("v", None)
    if version is True or version != PROTOCOL_VERSION:
        raise CodecError(
            f"{what}: protocol version {version!r:.40}, this program speaks {PROTOCOL_VERSION}; "
            "run the same release of semantic-mapper on both sides"
        )
    return fields


def check_header(header: object, kind: type[WireT], what: str) -> WireT:
    """Plain fields -> a struct or dataclass. Values that are arrays already, or such objects, stay what they are.

    Raises:
        CodecError: an unknown or missing field, a wrong type, a number out of bounds or not finite, or what
            ``__post_init__`` refuses; names the field.
    """
    try:
        return msgspec.convert(header, kind)
    except (ValueError, TypeError, RecursionError, OverflowError) as error:
        raise CodecError(f"{what}: bad header: {_BEYOND.sub('only finite numbers can be sent', str(error))}") from error


def _plain_number(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"no header holds a {type(value).__name__}")
