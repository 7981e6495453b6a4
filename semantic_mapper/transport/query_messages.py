"""Questions about a map and their answers: one table of what each carries, as typed headers and plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from semantic_mapper.transport.headers import (
    Count,
    Digest,
    Header,
    LabelSetHeader,
    PartBytes,
    Plain,
    Sentence,
    Stamp,
    Word,
)

MAX_REQUEST_ROWS = 1 << 16  # points, rays or poses of one question
BLOCK_VOXELS = 512
MAX_WAIT_S = 3600.0  # for an answer, of who does not say

Point = tuple[float, float, float]
DType = Literal["u1", "i1", "<i4", "<i8", "<f4", "<f8"]


class ArraySpec(Plain, frozen=True, kw_only=True):
    """One buffer: its array's shape and its size as sent."""

    shape: Annotated[tuple[Annotated[int, Meta(ge=0, le=1 << 31)], ...], Meta(max_length=4)]
    bytes: PartBytes


ArraySpecs = Annotated[tuple[ArraySpec, ...], Meta(max_length=6)]


class RequestHeader(Header, frozen=True, kw_only=True):
    """Of every question; the buffers are those that ``QUESTIONS`` names, in that order.

    ``asker`` is the same for all questions of a client that has one at a time, through whichever socket; empty = a
    stranger. Nobody waits for the answer after ``waits_s``.
    """

    arrays: ArraySpecs = ()
    asker: Word = ""
    waits_s: Annotated[float, Meta(ge=0, le=MAX_WAIT_S)] = MAX_WAIT_S


class AnswerHeader(Header, frozen=True, kw_only=True):
    """Of every answer: which state of which map it is about.

    ``map_id`` is another one after the mapper was started anew; versions of two maps cannot be compared.
    """

    map_id: Word
    version: Count
    epoch: Count
    arrays: ArraySpecs = ()


class InfoRequest(RequestHeader, frozen=True, kw_only=True):
    """What the map is."""


class InfoAnswer(AnswerHeader, frozen=True, kw_only=True):
    """What the map is."""

    blocks: Count
    voxel_size_m: float
    truncation_voxels: float
    label_set: LabelSetHeader


class AtRequest(RequestHeader, frozen=True, kw_only=True):
    """What is at points."""

    radius_m: float | None = None


class NearestRequest(RequestHeader, frozen=True, kw_only=True):
    """Where the nearest surface of a class is."""

    class_name: Word
    point: Point
    min_confidence: float = 0.0


class NearestAnswer(AnswerHeader, frozen=True, kw_only=True):
    """Where it is; zeros where ``found`` is false."""

    found: bool
    xyz: Point
    distance_m: float
    confidence: float


class RaysRequest(RequestHeader, frozen=True, kw_only=True):
    """What rays meet."""

    max_m: float


class BoxRequest(RequestHeader, frozen=True, kw_only=True):
    """Surface points in a box."""

    lower: Point
    upper: Point


class InstancesRequest(RequestHeader, frozen=True, kw_only=True):
    """Countable things."""

    up: Point


class OccupancyRequest(RequestHeader, frozen=True, kw_only=True):
    """Free, occupied or unknown at points."""


class DistanceRequest(RequestHeader, frozen=True, kw_only=True):
    """Distances to obstacles in a box."""

    lower: Point
    upper: Point
    unknown_is_occupied: bool = False


class DistanceAnswer(AnswerHeader, frozen=True, kw_only=True):
    """Where its grid lies."""

    origin_m: Point
    voxel_size_m: float


class ChangesRequest(RequestHeader, frozen=True, kw_only=True):
    """Blocks changed since a version of the map ``map_id``; of another map, all blocks are sent."""

    since: Count
    limit: Count = 0  # blocks, see ``VoxelMap.changes``; 0 = all
    map_id: Word = ""


class ChangesAnswer(AnswerHeader, frozen=True, kw_only=True):
    """Where these blocks begin; complete up to ``version``, while the map is at ``newest``."""

    since: Count
    newest: Count


class CorrectPosesRequest(RequestHeader, frozen=True, kw_only=True):
    """Move the map to corrected poses of its frames; the one request that changes something.

    ``id`` makes it safe to ask again where an answer was lost: of requests with the same one, the first counts.
    """

    id: Word
    cameras: Annotated[tuple[Word, ...], Meta(min_length=1, max_length=256)]  # ("",) = whichever took the frame
    until_ns: Stamp | None = None  # see ``MappingPipeline.correct_poses``
    within_ns: Annotated[int, Meta(ge=0, le=1_000_000_000)] = 0  # how far from a stamp its frame may be


class CorrectionRequest(RequestHeader, frozen=True, kw_only=True):
    """How far corrections are."""


class CorrectionAnswer(AnswerHeader, frozen=True, kw_only=True):
    """``CorrectionStatus`` of the map itself, which is ahead of the mirror that ``version`` and ``epoch`` speak of."""

    used: Count  # poses of this request; 0 where none were sent
    left_out: Count  # those of them without a frame
    running: bool
    done: Count
    total: Count
    completed: Count
    poses: Count
    frozen: Count
    lost: Count
    failure: Sentence
    map_epoch: Count


class WeightsRequest(RequestHeader, frozen=True, kw_only=True):
    """Which weights there are; with ``to``, go back to these. To ask twice is as to ask once."""

    to: Count | None = None


class WeightsEntry(Plain, frozen=True, kw_only=True):
    """Weights that a mapper was started with (version 0) or was offered."""

    version: Count
    digest: Digest
    state: Literal["in use", "earlier", "refused", "rolled back"]
    score: float
    parent_score: float
    keyframes: Count
    reason: Sentence


class WeightsAnswer(AnswerHeader, frozen=True, kw_only=True):
    """Which weights there are; ``before`` were in use before, ``wanted`` are about to be."""

    in_use: Count
    before: Count | None
    wanted: Count | None
    weights_taken: Count
    weights_refused: Count
    weights_rolled_back: Count
    entries: Annotated[tuple[WeightsEntry, ...], Meta(max_length=256)]


class ErrorAnswer(Header, frozen=True, kw_only=True):
    """The name of an error class of ours, and what it says."""

    error: Word
    text: Sentence


@dataclass(frozen=True, slots=True)
class ArrayForm:
    """What an array must look like.

    Args:
        dtype: Of its elements; arrays of bytes travel compressed.
        tail: Its last axes.
        free: Number of axes before these, of any length.
    """

    dtype: DType
    tail: tuple[int, ...] = ()
    free: int = 1


@dataclass(frozen=True, slots=True)
class Question:
    """One row of the table.

    Args:
        request, answer: Types of the headers.
        takes, gives: Arrays of question and answer.
        aligned: Whether all arrays of the answer have the same free axes.
    """

    request: type[RequestHeader]
    answer: type[AnswerHeader] = AnswerHeader
    takes: dict[str, ArrayForm] = field(default_factory=dict[str, ArrayForm])
    gives: dict[str, ArrayForm] = field(default_factory=dict[str, ArrayForm])
    aligned: bool = True


_POINTS = ArrayForm("<f8", (3,))
_U8, _F32, _RGB = ArrayForm("u1"), ArrayForm("<f4"), ArrayForm("u1", (3,))

QUESTIONS = {
    "info": Question(InfoRequest, InfoAnswer),
    "at": Question(
        AtRequest,
        takes={"points": _POINTS},
        gives={"label": _U8, "confidence": _F32, "distance_m": _F32, "state": _U8},
    ),
    "nearest": Question(NearestRequest, NearestAnswer),
    "cast_rays": Question(
        RaysRequest,
        takes={"origins": _POINTS, "directions": _POINTS},
        gives={"distance_m": _F32, "label": _U8, "confidence": _F32, "rgb": _RGB},
    ),
    "points_in_box": Question(
        BoxRequest,
        gives={"xyz": ArrayForm("<f4", (3,)), "rgb": _RGB, "label": _U8, "confidence": _F32},
    ),
    "instances": Question(
        InstancesRequest,
        gives={
            "numbers": ArrayForm("<i8", (3,)),  # id, class id, voxels
            "places": ArrayForm("<f8", (19,)),  # confidence, centroid, box: center, size, R_world_box row by row
            "voxels": ArrayForm("<i4", (3,)),  # of all things, one behind the other
        },
        aligned=False,
    ),
    "occupancy": Question(OccupancyRequest, takes={"points": _POINTS}, gives={"state": _U8}),
    "distance_field": Question(
        DistanceRequest,
        DistanceAnswer,
        gives={"distance_m": ArrayForm("<f4", free=3), "state": ArrayForm("u1", free=3)},
    ),
    "changes": Question(
        ChangesRequest,
        ChangesAnswer,
        gives={
            "keys": ArrayForm("<i4", (3,)),
            "tsdf": ArrayForm("i1", (BLOCK_VOXELS,)),
            "label": ArrayForm("u1", (BLOCK_VOXELS,)),
            "confidence": ArrayForm("u1", (BLOCK_VOXELS,)),
            "rgb": ArrayForm("u1", (BLOCK_VOXELS, 3)),
        },
    ),
    "correct_poses": Question(
        CorrectPosesRequest,
        CorrectionAnswer,
        takes={"stamps_ns": ArrayForm("<i8"), "camera": _U8, "poses": ArrayForm("<f8", (4, 4))},  # index of ``cameras``
    ),
    "correction": Question(CorrectionRequest, CorrectionAnswer),
    "weights": Question(WeightsRequest, WeightsAnswer),
}
