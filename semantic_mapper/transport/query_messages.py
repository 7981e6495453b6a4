"""Questions about a map and their answers: one struct each, whose array fields travel as buffers, and one table."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Annotated, Literal, get_type_hints

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from semantic_mapper.transport.messages import (
    Count,
    Digest,
    Finite,
    LabelSetForm,
    PartBytes,
    Sentence,
    Stamp,
    Wire,
    Word,
)
from semantic_mapper.types import Float32, Float64, Int32, Int64, UInt8

MAX_REQUEST_ROWS = 1 << 16  # points, rays or poses of one question
BLOCK_VOXELS = 512
MAX_WAIT_S = 3600.0  # for an answer, of who does not say

Point = tuple[Finite, Finite, Finite]
DType = Literal["u1", "i1", "<i4", "<i8", "<f4", "<f8"]


@dataclass(frozen=True, slots=True)
class ArrayForm:
    """What an array must look like.

    Args:
        dtype: Of its elements; arrays of bytes travel compressed.
        tail: Its last axes.
        free: Number of axes before these, of any length.
        optional: It may be left out (None): it came later, and what does not need it is read by older releases, too.
            Such fields are the last arrays of their message.
    """

    dtype: DType
    tail: tuple[int, ...] = ()
    free: int = 1
    optional: bool = False

    @property
    def is_compressed(self) -> bool:
        """Whether its buffer is compressed."""
        return np.dtype(self.dtype).itemsize == 1


Points = Annotated[Float64, ArrayForm("<f8", (3,))]
Labels = Annotated[UInt8, ArrayForm("u1")]
Floats = Annotated[Float32, ArrayForm("<f4")]
Colors = Annotated[UInt8, ArrayForm("u1", (3,))]
Computed = Annotated[UInt8 | None, ArrayForm("u1", optional=True)]  # 1 where no sensor measured it; None = nowhere


@functools.cache
def array_forms(kind: type) -> dict[str, ArrayForm]:
    """Array fields of a question or an answer, in the order of their buffers."""
    hints = get_type_hints(kind, include_extras=True)
    noted = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return {name: notes[0] for name, notes in noted.items() if notes and isinstance(notes[0], ArrayForm)}


class ArraySpec(Wire, frozen=True):
    """One buffer: its array's shape and its size as sent."""

    shape: Annotated[tuple[Annotated[int, Meta(ge=0, le=1 << 31)], ...], Meta(max_length=4)]
    bytes: PartBytes


ArraySpecs = Annotated[tuple[ArraySpec, ...], Meta(max_length=6)]


class Request(Wire, frozen=True, kw_only=True):
    """Of every question; ``arrays`` says how its array fields travel, and is filled in by the codec.

    ``asker`` is the same for all questions of a client that has one at a time, through whichever socket; empty = a
    stranger. Nobody waits for the answer after ``waits_s``.
    """

    arrays: ArraySpecs = ()
    asker: Word = ""
    waits_s: Annotated[float, Meta(ge=0, le=MAX_WAIT_S)] = MAX_WAIT_S


class Answer(Wire, frozen=True, kw_only=True):
    """Of every answer: which state of which map it is about.

    ``map_id`` is another one after the mapper was restarted; versions of two maps cannot be compared. With
    ``scale_unknown`` its lengths are not metres; sent only then.
    """

    map_id: Word
    version: Count
    epoch: Count
    arrays: ArraySpecs = ()
    scale_unknown: bool = False


class InfoRequest(Request, frozen=True, kw_only=True):
    """What the map is."""


class InfoAnswer(Answer, frozen=True, kw_only=True):
    """What the map is."""

    blocks: Count
    voxel_size_m: Finite
    truncation_voxels: Finite
    label_set: LabelSetForm


class AtRequest(Request, frozen=True, kw_only=True):
    """What is at points."""

    points: Points
    radius_m: Finite | None = None


class AtAnswer(Answer, frozen=True, kw_only=True):
    """``PointAnswers``."""

    label: Labels
    confidence: Floats
    distance_m: Floats
    state: Labels
    computed: Computed = None


class NearestRequest(Request, frozen=True, kw_only=True):
    """Where the nearest surface of a class is."""

    class_name: Word
    point: Point
    min_confidence: Finite = 0.0


class NearestAnswer(Answer, frozen=True, kw_only=True):
    """Where it is; zeros where ``found`` is false."""

    found: bool
    xyz: Point
    distance_m: Finite
    confidence: Finite
    computed: bool = False  # no sensor measured it; sent only then


class RaysRequest(Request, frozen=True, kw_only=True):
    """What rays meet."""

    max_m: Finite
    origins: Points
    directions: Points


class RaysAnswer(Answer, frozen=True, kw_only=True):
    """``RayHits``."""

    distance_m: Floats
    label: Labels
    confidence: Floats
    rgb: Colors
    computed: Computed = None


class BoxRequest(Request, frozen=True, kw_only=True):
    """Surface points in a box."""

    lower: Point
    upper: Point


class BoxAnswer(Answer, frozen=True, kw_only=True):
    """``MapPoints``."""

    xyz: Annotated[Float32, ArrayForm("<f4", (3,))]
    rgb: Colors
    label: Labels
    confidence: Floats
    computed: Computed = None


class InstancesRequest(Request, frozen=True, kw_only=True):
    """Countable things; ``gone``: also those that have gone lately (sent only then)."""

    up: Point
    gone: bool = False


class InstancesAnswer(Answer, frozen=True, kw_only=True):
    """All things, packed.

    ``numbers``: id, class id, voxels. ``places``: confidence, centroid, box: center, size, R_world_box row by row.
    ``voxels``: of all things, one behind the other. ``measured``: fraction of each, None = 1. ``gone_ns``: stamp of the
    frame at which most of each was gone, -1 = it is there; None = that was not asked.
    """

    numbers: Annotated[Int64, ArrayForm("<i8", (3,))]
    places: Annotated[Float64, ArrayForm("<f8", (19,))]
    voxels: Annotated[Int32, ArrayForm("<i4", (3,))]
    measured: Annotated[Float64 | None, ArrayForm("<f8", optional=True)] = None
    gone_ns: Annotated[Int64 | None, ArrayForm("<i8", optional=True)] = None


class OccupancyRequest(Request, frozen=True, kw_only=True):
    """Free, occupied or unknown at points."""

    points: Points


class OccupancyAnswer(Answer, frozen=True, kw_only=True):
    """A ``State`` for each point."""

    state: Labels


class DistanceRequest(Request, frozen=True, kw_only=True):
    """Distances to obstacles in a box."""

    lower: Point
    upper: Point
    unknown_is_occupied: bool = False


class DistanceAnswer(Answer, frozen=True, kw_only=True):
    """Where its grid lies."""

    origin_m: Point
    voxel_size_m: Finite
    distance_m: Annotated[Float32, ArrayForm("<f4", free=3)]
    state: Annotated[UInt8, ArrayForm("u1", free=3)]


class ChangesRequest(Request, frozen=True, kw_only=True):
    """Blocks changed since a version of the map ``map_id``; of another map, all blocks are sent."""

    since: Count
    limit: Count = 0  # blocks, see ``VoxelMap.changes``; 0 = all
    map_id: Word = ""


class ChangesAnswer(Answer, frozen=True, kw_only=True):
    """Where these blocks begin; complete up to ``version``, while the map is at ``newest``."""

    since: Count
    newest: Count
    keys: Annotated[Int32, ArrayForm("<i4", (3,))]
    tsdf: Annotated[NDArray[np.int8], ArrayForm("i1", (BLOCK_VOXELS,))]
    label: Annotated[UInt8, ArrayForm("u1", (BLOCK_VOXELS,))]
    confidence: Annotated[UInt8, ArrayForm("u1", (BLOCK_VOXELS,))]
    rgb: Annotated[UInt8, ArrayForm("u1", (BLOCK_VOXELS, 3))]
    computed: Annotated[UInt8 | None, ArrayForm("u1", (BLOCK_VOXELS,), optional=True)] = None


class CorrectPosesRequest(Request, frozen=True, kw_only=True):
    """Move the map to corrected poses of its frames; the one request that changes something.

    ``id`` makes it safe to ask again where an answer was lost: of requests with the same one, the first counts.
    """

    id: Word
    cameras: Annotated[tuple[Word, ...], Meta(min_length=1, max_length=256)]  # ("",) = whichever took the frame
    until_ns: Stamp | None = None  # see ``MappingPipeline.correct_poses``
    within_ns: Annotated[int, Meta(ge=0, le=1_000_000_000)] = 0  # how far from a stamp its frame may be
    stamps_ns: Annotated[Int64, ArrayForm("<i8")]
    camera: Labels  # index of ``cameras``
    poses: Annotated[Float64, ArrayForm("<f8", (4, 4))]


class CorrectionRequest(Request, frozen=True, kw_only=True):
    """How far corrections are."""


class CorrectionAnswer(Answer, frozen=True, kw_only=True):
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


class WeightsRequest(Request, frozen=True, kw_only=True):
    """Which weights there are; with ``to``, go back to these. To ask twice is as to ask once."""

    to: Count | None = None


class WeightsEntry(Wire, frozen=True):
    """Weights that a mapper was started with (version 0) or was offered."""

    version: Count
    digest: Digest
    state: Literal["in use", "earlier", "refused", "rolled back"]
    score: Finite
    parent_score: Finite
    keyframes: Count
    reason: Sentence


class WeightsAnswer(Answer, frozen=True, kw_only=True):
    """Which weights there are; ``before`` were in use before, ``wanted`` are about to be."""

    in_use: Count
    before: Count | None
    wanted: Count | None
    weights_taken: Count
    weights_refused: Count
    weights_rolled_back: Count
    entries: Annotated[tuple[WeightsEntry, ...], Meta(max_length=256)]


class PoseRequest(Request, frozen=True, kw_only=True):
    """Where the last frame was taken."""


class PoseAnswer(Answer, frozen=True, kw_only=True):
    """``CameraPose``; no ``camera_id`` before the first frame, no ``T_map_camera`` (row by row) where not known."""

    camera_id: Word = ""
    stamp_ns: Stamp = 0
    T_map_camera: Annotated[tuple[Finite, ...], Meta(max_length=16)] = ()
    reason: Sentence = ""


class ErrorAnswer(Wire, frozen=True):
    """The name of an error class of ours, and what it says."""

    error: Word
    text: Sentence


@dataclass(frozen=True, slots=True)
class Question:
    """One row of the table.

    Args:
        request, answer: Types of question and answer.
        aligned: Whether all arrays of the answer have the same free axes.
    """

    request: type[Request]
    answer: type[Answer]
    aligned: bool = True


QUESTIONS = {
    "info": Question(InfoRequest, InfoAnswer),
    "at": Question(AtRequest, AtAnswer),
    "nearest": Question(NearestRequest, NearestAnswer),
    "cast_rays": Question(RaysRequest, RaysAnswer),
    "points_in_box": Question(BoxRequest, BoxAnswer),
    "instances": Question(InstancesRequest, InstancesAnswer, aligned=False),
    "occupancy": Question(OccupancyRequest, OccupancyAnswer),
    "distance_field": Question(DistanceRequest, DistanceAnswer),
    "changes": Question(ChangesRequest, ChangesAnswer),
    "correct_poses": Question(CorrectPosesRequest, CorrectionAnswer),
    "correction": Question(CorrectionRequest, CorrectionAnswer),
    "weights": Question(WeightsRequest, WeightsAnswer),
    "pose": Question(PoseRequest, PoseAnswer),
}
