"""Questions to the map of a running mapper, their answers, and both as bytes: ``[name, msgpack header, arrays]``.

A question is a struct, an answer any struct or frozen dataclass, as the functions of this package return them. Where
one has an array, its header says ``{dtype, shape, start, bytes}``: its elements, little-endian and row by row, lie in
the third part from ``start`` on; of single bytes, a zstd frame.

Header of a question: its fields. Of an answer: ``map`` (``MapState``) and ``answer``. In the place of an answer may
come an error, ``["error", header]``. Sizes are checked before they are allocated, else ``CodecError``."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from semantic_mapper import errors
from semantic_mapper.errors import CodecError, SemanticMapperError, TransportError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.changes import BlockChanges
from semantic_mapper.mapping.map_types import CameraPose, CorrectionStatus, MapPoints
from semantic_mapper.queries.find import FoundObject
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
from semantic_mapper.queries.objects import MapObject, ObjectChange, changes_of
from semantic_mapper.queries.occupancy import DistanceField
from semantic_mapper.queries.surface import RayHits
from semantic_mapper.transport.codec import check_header, pack_header, unpack_header
from semantic_mapper.transport.images import zstd_compress, zstd_decompress
from semantic_mapper.transport.messages import (
    MAX_PART_BYTES,
    Count,
    Finite,
    PartBytes,
    Parts,
    Sentence,
    Stamp,
    Wire,
    Word,
)
from semantic_mapper.types import Float64, Int64, UInt8

MAX_REQUEST_ROWS = 1 << 16  # points, rays or poses of one question
MAX_ANSWER_HEADER_BYTES = 1 << 22  # some 10,000 things
MAX_WAIT_S = 3600.0  # for an answer, of a client that does not say

AnswerT = TypeVar("AnswerT")

_ERROR = "error"  # in the place of an answer's name
_RAISED = {
    e.__name__: e for e in (errors.MapError, errors.LabelError, errors.CodecError, errors.ShapeError, errors.PoseError)
}


class Request(Wire, Generic[AnswerT], frozen=True, kw_only=True):
    """What every question has; ``AnswerT`` answers it. ``asker`` is the same for all questions of a client that awaits
    each answer; empty = not known. Nobody waits for the answer after ``waits_s``."""

    takes_long: ClassVar[bool] = False  # more than a few milliseconds
    about_map: ClassVar[bool] = True  # answered from a snapshot, which has to be up to date
    of_memory: ClassVar[bool] = False  # or as of the last update of what the map remembers

    asker: Word = ""
    waits_s: Annotated[float, Meta(ge=0, le=MAX_WAIT_S)] = MAX_WAIT_S


class MapState(Wire, frozen=True):
    """Which state of which map an answer is about. ``map_id`` is another one after the mapper was restarted."""

    map_id: Word
    version: Count
    epoch: Count


class _ArraySpec(Wire, frozen=True):
    dtype: Literal["|b1", "|u1", "|i1", "<i2", "<i4", "<i8", "<f4", "<f8"]
    shape: Annotated[tuple[Annotated[int, Meta(ge=0, le=1 << 31)], ...], Meta(min_length=1, max_length=4)]
    start: PartBytes
    bytes: PartBytes


class _ErrorHeader(Wire, frozen=True):
    """The name of an error class of ours, and what it says."""

    error: Word
    text: Sentence


Point = tuple[Finite, Finite, Finite]


@dataclass(frozen=True, slots=True)
class MapInfo:
    """What a map is."""

    map_id: str  # another one after the mapper was restarted
    # version, epoch: ``VoxelMap``'s.
    version: int
    epoch: int
    blocks: int  # of 8^3 voxels
    voxel_size_m: float  # edge of a voxel
    truncation_voxels: float  # of the TSDF
    label_set: LabelSet  # its classes
    scale_known: bool = True  # whether its lengths are metres


@dataclass(frozen=True, slots=True)
class Correction(CorrectionStatus):
    """Where the corrections of a mapper stand."""

    # used, left_out: Poses of the request that this answers: with a frame in the history, and without.
    used: int = 0
    left_out: int = 0
    epoch: int = 0  # of the map in use: answers of this or a later ``MapInfo.epoch`` are about it


@dataclass(frozen=True, slots=True)
class WeightsEntry:
    """Weights that a mapper was started with (version 0) or was offered."""

    version: int  # ascending; 0 = those that it was started with
    digest: str  # SHA-256 of the file, hexadecimal
    state: Literal["in use", "earlier", "refused"]  # what became of them
    # score, parent_score: Of these, and of those in use then, on the keyframes that judged them.
    score: float = 0.0
    parent_score: float = 0.0
    keyframes: int = 0  # that they were learned from
    reason: str = ""  # why they were refused; empty otherwise


@dataclass(frozen=True, slots=True)
class Weights:
    """Which weights a mapper uses, and what became of those that it was offered."""

    in_use: int  # version; 0 = those that it was started with
    # taken, refused: How often that has happened.
    taken: int
    refused: int
    versions: tuple[WeightsEntry, ...]  # all that it knows of, the oldest first


@dataclass(frozen=True, slots=True, eq=False)
class RememberedObjects:
    """What a map remembers of its things, and the last stamp of the map that it goes on in (0 = of none)."""

    objects: tuple[MapObject, ...]
    since_ns: int

    @classmethod
    def of_saved(cls, objects: tuple[MapObject, ...]) -> "RememberedObjects":
        """Of a saved map, since its first visit, where there was another."""
        first = min((o.places[0].stamp_ns for o in objects), default=0)
        last = max((max(o.places[-1].stamp_ns, o.last_seen_ns, o.gone_ns or 0) for o in objects), default=0)
        return cls(objects, first if last > first else 0)

    @property
    def changes(self) -> tuple[ObjectChange, ...]:
        """What has become of them since, the surest first."""
        return changes_of(self.objects, self.since_ns) if self.since_ns else ()


class InfoRequest(Request[MapInfo], frozen=True, kw_only=True):
    """What the map is."""


class AtRequest(Request[PointAnswers], frozen=True, kw_only=True):
    """What is at points (N, 3); see ``nearest.at``."""

    points: Float64
    radius_m: Finite | None = None


class NearestRequest(Request[NearestSurface | None], frozen=True, kw_only=True):
    """Where the nearest surface of a class is, and the thing there; see ``nearest.nearest``."""

    class_name: Word
    point: Point
    min_confidence: Finite = 0.0
    unsure: bool = False
    up: Point = (0.0, 0.0, 1.0)


class RaysRequest(Request[RayHits], frozen=True, kw_only=True):
    """What rays meet; see ``surface.cast_rays``."""

    max_m: Finite
    origins: Float64
    directions: Float64


class BoxRequest(Request[MapPoints], frozen=True, kw_only=True):
    """Surface points in a box; see ``surface.points_in_box``."""

    takes_long: ClassVar[bool] = True
    lower: Point
    upper: Point


class InstancesRequest(Request[tuple[Instance, ...]], frozen=True, kw_only=True):
    """Countable things; ``unsure``: also those of low certainty; ``gone``: also those that have gone lately."""

    takes_long: ClassVar[bool] = True
    up: Point
    gone: bool = False
    unsure: bool = False


class ObjectsRequest(Request[RememberedObjects], frozen=True, kw_only=True):
    """What the map remembers of its things; ``up`` (3,), None = by the floor."""

    takes_long: ClassVar[bool] = True
    of_memory: ClassVar[bool] = True
    up: Point | None = None


class FindRequest(Request[tuple[FoundObject, ...]], frozen=True, kw_only=True):
    """The objects that a phrase means; see ``find.find``. ``up`` as of ``ObjectsRequest``."""

    takes_long: ClassVar[bool] = True
    of_memory: ClassVar[bool] = True
    phrase: Sentence
    limit: int = 5
    up: Point | None = None


class OccupancyRequest(Request[UInt8], frozen=True, kw_only=True):
    """Free, occupied or unknown at points (N, 3); see ``occupancy.occupancy``."""

    points: Float64


class DistanceRequest(Request[DistanceField], frozen=True, kw_only=True):
    """Distances to obstacles in a box; see ``occupancy.distance_field``."""

    takes_long: ClassVar[bool] = True
    lower: Point
    upper: Point
    unknown_is_occupied: bool = False


class ChangesRequest(Request[BlockChanges], frozen=True, kw_only=True):
    """Blocks changed since a version of the map ``map_id``; of another map, all blocks are sent."""

    takes_long: ClassVar[bool] = True
    since: Count
    limit: Count = 0  # blocks, see ``VoxelMap.changes``; 0 = all
    map_id: Word = ""


class CorrectPosesRequest(Request[Correction], frozen=True, kw_only=True):
    """Move the map to corrected poses of its frames. Of requests with the same ``id``, the first counts."""

    takes_long: ClassVar[bool] = True
    about_map: ClassVar[bool] = False
    id: Word
    cameras: Annotated[tuple[Word, ...], Meta(min_length=1, max_length=256)]  # ("",) = whichever took the frame
    until_ns: Stamp | None = None  # see ``MapCorrector.start``
    within_ns: Annotated[int, Meta(ge=0, le=1_000_000_000)] = 0  # how far from a stamp its frame may be
    stamps_ns: Int64  # (N,)
    camera: UInt8  # (N,) index of ``cameras``
    poses: Float64  # (N, 4, 4)


class CorrectionRequest(Request[Correction], frozen=True, kw_only=True):
    """Where corrections stand; of the map itself, which is ahead of its snapshots."""

    about_map: ClassVar[bool] = False


class WeightsRequest(Request[Weights], frozen=True, kw_only=True):
    """Which weights there are."""

    about_map: ClassVar[bool] = False


class PoseRequest(Request[CameraPose | None], frozen=True, kw_only=True):
    """Where the last frame was taken."""

    about_map: ClassVar[bool] = False


class Question(NamedTuple):
    """One row of the table: the struct of the question, and the type that answers it."""

    request: type[Request[Any]]
    answer: Any


QUESTIONS = {
    "info": Question(InfoRequest, MapInfo),
    "at": Question(AtRequest, PointAnswers),
    "nearest": Question(NearestRequest, NearestSurface | None),
    "cast_rays": Question(RaysRequest, RayHits),
    "points_in_box": Question(BoxRequest, MapPoints),
    "instances": Question(InstancesRequest, tuple[Instance, ...]),
    "objects": Question(ObjectsRequest, RememberedObjects),
    "find": Question(FindRequest, tuple[FoundObject, ...]),
    "occupancy": Question(OccupancyRequest, UInt8),
    "distance_field": Question(DistanceRequest, DistanceField),
    "changes": Question(ChangesRequest, BlockChanges),
    "correct_poses": Question(CorrectPosesRequest, Correction),
    "correction": Question(CorrectionRequest, Correction),
    "weights": Question(WeightsRequest, Weights),
    "pose": Question(PoseRequest, CameraPose | None),
}
NAMES = {question.request: name for name, question in QUESTIONS.items()}


def decode_question(parts: Parts) -> Request[Any]:
    """A question of any kind; CodecError for anything that ``encode_request`` would not have made."""
    name = read_name(parts)
    if name not in QUESTIONS:
        raise CodecError(f"unknown question {name!r}; there are {', '.join(QUESTIONS)}")
    return _convert(unpack_header(parts[1], name), QUESTIONS[name].request, parts, name, MAX_REQUEST_ROWS)


def encode_request(name: str, request: Request[Any]) -> list[bytes]:
    """Question -> parts; CodecError for too many rows, or a value that cannot be sent."""
    parts = _encode(name, {}, request, name)
    decode_question(parts)  # as its reader will
    return parts


def read_name(parts: Parts) -> str:
    """The name of a question or answer; CodecError if it is neither."""
    if not 2 <= len(parts) <= 3:
        raise CodecError(f"a question or answer has 2 or 3 parts, got {len(parts)}")
    return bytes(parts[0][:32]).decode("ascii", errors="replace")


def encode_answer(name: str, state: MapState, answer: object) -> list[bytes]:
    """Answer -> parts; CodecError for one that is too large, or a value that cannot be sent."""
    return _encode(name, {"map": msgspec.to_builtins(state)}, answer, f"answer to '{name}'")


def encode_error(error: SemanticMapperError) -> list[bytes]:
    """An error in the place of an answer; an overlong text is cut."""
    text = str(error).encode("utf-8", errors="replace").decode()[:4000]
    return [_ERROR.encode(), pack_header({"error": type(error).__name__, "text": text}, "error")]


def decode_answer(name: str, kind: type[AnswerT], parts: Parts) -> tuple[MapState, AnswerT]:
    """Parts -> what the answer to question ``name`` is about, and the answer; its arrays are fresh and writable.

    ``MapError``, ``LabelError``, ``CodecError``, ``ShapeError``, ``PoseError``: the other side answered with this
    error; ``TransportError``: with another one. ``CodecError``: no answer, or one to another question."""
    what = f"answer to '{name}'"
    actual = read_name(parts)
    header = unpack_header(parts[1], what, MAX_ANSWER_HEADER_BYTES)
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
    header = (
        pack_header({**about, "answer": plain}, what, MAX_ANSWER_HEADER_BYTES) if about else pack_header(plain, what)
    )
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
