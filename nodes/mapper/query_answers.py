"""From a question's bytes to its answer's: which query is asked, and how much of it at once."""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import structlog

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.moving import MovingSpace
from semantic_mapper.mapping.storage.changes import BlockChanges
from semantic_mapper.mapping.worlds import Whereabouts
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.live_weights import LiveWeights
from semantic_mapper.queries.boxes import points_in_box
from semantic_mapper.queries.instances import Instance, InstanceTracker
from semantic_mapper.queries.lookup import MAX_RADIUS_VOXELS, RADIUS_VOXELS, PointAnswers, at
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.occupancy import distance_field, occupancy
from semantic_mapper.queries.rays import RayHits, cast_rays
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.transport import query_messages as messages
from semantic_mapper.transport.codec import decode_request, encode_answer, encode_error
from semantic_mapper.transport.messages import LabelSetForm, Parts
from semantic_mapper.types import UInt8

# One worker answers all that takes long: what would keep the others waiting for more than about a second is refused.
MAX_VISITED_VOXELS = 1e8  # of `at`
MAX_RAY_METRES = 2e5  # of `cast_rays`, all rays together
MAX_FIELD_VOXELS = 1 << 22  # of `distance_field`
MAX_CHANGED_BLOCKS = 1 << 14  # of `changes`, unless one delivery has more
# What takes more than a few milliseconds takes long; the rest never waits for it.
LONG_VISITED_VOXELS = 1e5  # of `at`
LONG_RAY_METRES = 500.0  # of `cast_rays`
LONG_POINTS = 1 << 14  # of `occupancy`
LONG_BOX_VOXELS = 1 << 13  # of `distance_field` and `points_in_box`
_MAX_TRACKERS = 4  # one for each direction that was called up

_log = structlog.get_logger(__name__)


class Question(NamedTuple):
    """One question, ready to be answered.

    Args:
        answer: Gives the parts of its answer, which is an error where the question is no good; raises nothing.
        request: What it asks, and who asks.
        takes_long: Whether that may take more than a few milliseconds.
        about_map: Whether the answer comes from the mirror, which has to be up to date for it.
    """

    answer: Callable[[], list[bytes]]
    request: messages.Request
    takes_long: bool
    about_map: bool


class _Tracked(NamedTuple):
    """A tracker, and what it found last: in which version of the map."""

    tracker: InstanceTracker
    version: int
    things: tuple[Instance, ...]
    gone: tuple[Instance, ...]


class Answers:
    """Answers questions about what a mirror holds. Those that take long are for one thread, all others for any.

    Args:
        mirror: Of the map.
        correction: Takes corrected poses; without it they are refused.
        weights: Says which weights are in use, and exchanges them; without it such questions are refused.
        moving: Where something moves now that is left out of the map.
        whereabouts: Of the last frame.
    """

    def __init__(
        self,
        mirror: MapMirror,
        correction: LiveCorrection | None = None,
        weights: LiveWeights | None = None,
        moving: MovingSpace | None = None,
        whereabouts: Whereabouts | None = None,
    ) -> None:
        self.map_id = uuid.uuid4().hex
        self._mirror = mirror
        self._correction = correction
        self._weights = weights
        self._moving = moving
        self._whereabouts = whereabouts or Whereabouts()
        self._tracked: dict[messages.Point, _Tracked] = {}  # by direction; the last one asked stands last

    def read(self, parts: Parts) -> Question:
        """Parts of a question -> what answers it."""
        try:
            kind, request = decode_request(parts)
            takes_long = _takes_long(self._mirror.snapshot(), request)
        except (SemanticMapperError, MemoryError) as error:
            refusal = encode_error(_to_error(error))
            return Question(lambda: refusal, messages.Request(), takes_long=False, about_map=False)
        correction = messages.CorrectPosesRequest | messages.CorrectionRequest
        beside = correction | messages.WeightsRequest | messages.PoseRequest
        about_map = not isinstance(request, beside)
        return Question(lambda: self._encoded(kind, request), request, takes_long, about_map)

    def _encoded(self, kind: str, request: messages.Request) -> list[bytes]:
        try:
            return encode_answer(kind, self._answer(request))
        except (SemanticMapperError, MemoryError) as error:
            return encode_error(_to_error(error))
        except Exception as error:  # noqa: BLE001 -- a bug of ours must not end a thread that all wait for
            _log.exception("question_failed", question=kind)
            return encode_error(MapError(f"the mapper could not compute this: {error}"))

    def _answer(self, request: messages.Request) -> messages.Answer:
        snapshot = self._mirror.snapshot()
        match request:
            case messages.InfoRequest():
                return self._describe(snapshot)
            case messages.AtRequest():
                _bound_points(snapshot, request)
                return self._plain(
                    snapshot, messages.AtAnswer, at(self._with_moving(snapshot), request.points, request.radius_m)
                )
            case messages.NearestRequest():
                return self._nearest(snapshot, request)
            case messages.RaysRequest():
                _bound_rays(request)
                hits = cast_rays(snapshot, request.origins, request.directions, request.max_m)
                return self._plain(snapshot, messages.RaysAnswer, hits)
            case messages.BoxRequest():
                found = points_in_box(snapshot, request.lower, request.upper)
                return self._plain(snapshot, messages.BoxAnswer, found)
            case messages.InstancesRequest():
                return self._instances(snapshot, request)
            case messages.OccupancyRequest():
                state = occupancy(self._with_moving(snapshot), request.points)
                return messages.OccupancyAnswer(**self._about(snapshot), state=state)
            case messages.DistanceRequest():
                return self._distances(self._with_moving(snapshot), request)
            case messages.ChangesRequest():
                return self._changes(snapshot, request)
            case messages.CorrectPosesRequest() | messages.CorrectionRequest():
                return self._correct(snapshot, request)
            case messages.WeightsRequest():
                return self._exchange_weights(snapshot, request)
            case messages.PoseRequest():
                return self._pose(snapshot)
            case _:
                raise MapError(f"{type(request).__name__}: cannot be answered")

    def _pose(self, snapshot: MapSnapshot) -> messages.Answer:
        last = self._whereabouts.last
        if last is None:
            return messages.PoseAnswer(**self._about(snapshot))
        pose = () if last.T_map_camera is None else tuple(last.T_map_camera.ravel().tolist())
        where = {"camera_id": last.camera_id, "stamp_ns": last.stamp_ns, "reason": last.reason}
        return messages.PoseAnswer(**self._about(snapshot), **where, T_map_camera=pose)

    def _with_moving(self, snapshot: MapSnapshot) -> MapSnapshot:
        return snapshot if self._moving is None else snapshot.with_moving(self._moving.points)

    def _correct(
        self,
        snapshot: MapSnapshot,
        request: messages.CorrectPosesRequest | messages.CorrectionRequest,
    ) -> messages.Answer:
        correction = self._correction
        if correction is None:
            raise MapError("poses cannot be corrected here: this service only answers questions")
        is_new = isinstance(request, messages.CorrectPosesRequest)
        state = correction.begin(request) if is_new else correction.describe()
        return messages.CorrectionAnswer(**self._about(snapshot), **state)

    def _exchange_weights(self, snapshot: MapSnapshot, request: messages.WeightsRequest) -> messages.Answer:
        weights = self._weights
        if weights is None:
            raise MapError("this mapper takes no weights while it runs (option `learner`)")
        state = weights.describe() if request.to is None else weights.ask_for(request.to)
        return messages.WeightsAnswer(**self._about(snapshot), **state)

    def _about(self, snapshot: MapSnapshot) -> dict[str, Any]:
        return {
            "map_id": self.map_id,
            "version": snapshot.version,
            "epoch": snapshot.epoch,
            "scale_unknown": not snapshot.scale_known,
        }

    def _plain(self, snapshot: MapSnapshot, kind: type[messages.Answer], found: object) -> messages.Answer:
        """The fields of a query's result are the arrays of its answer."""
        return kind(**self._about(snapshot), **_arrays(found, kind))

    def _describe(self, snapshot: MapSnapshot) -> messages.Answer:
        return messages.InfoAnswer(
            **self._about(snapshot),
            blocks=snapshot.block_count,
            voxel_size_m=snapshot.voxel_size_m,
            truncation_voxels=snapshot.truncation_voxels,
            label_set=LabelSetForm.of(snapshot.label_set),
        )

    def _nearest(self, snapshot: MapSnapshot, request: messages.NearestRequest) -> messages.Answer:
        hit = nearest(snapshot, request.class_name, request.point, request.min_confidence)
        return messages.NearestAnswer(
            **self._about(snapshot),
            found=hit is not None,
            xyz=(0.0, 0.0, 0.0) if hit is None else tuple(hit.xyz.tolist()),
            distance_m=0.0 if hit is None else hit.distance_m,
            confidence=0.0 if hit is None else hit.confidence,
            computed=hit is not None and not hit.measured,
        )

    def _instances(self, snapshot: MapSnapshot, request: messages.InstancesRequest) -> messages.Answer:
        up = request.up
        tracked = self._tracked.pop(up, None)  # out of here while it updates: one that fails half way is not used again
        if tracked is None or tracked.version != snapshot.version:
            tracker = tracked.tracker if tracked else InstanceTracker(up=up)
            tracked = _Tracked(tracker, snapshot.version, tracker.update(snapshot), tracker.gone)
        self._tracked[up] = tracked
        for old in list(self._tracked)[:-_MAX_TRACKERS]:
            del self._tracked[old]
        arrays = _thing_arrays((*tracked.things, *tracked.gone) if request.gone else tracked.things, gone=request.gone)
        return messages.InstancesAnswer(**self._about(snapshot), **arrays)

    def _distances(self, snapshot: MapSnapshot, request: messages.DistanceRequest) -> messages.Answer:
        sides = _box_sides(snapshot, request)
        if min(sides) > 0 and math.prod(sides) > MAX_FIELD_VOXELS:
            raise MapError(
                f"distance_field: a box of {' x '.join(f'{s:.0f}' for s in sides)} voxels; over a socket at most "
                f"{MAX_FIELD_VOXELS} are computed at once; keep a mirror for more"
            )
        found = distance_field(snapshot, request.lower, request.upper, unknown_is_occupied=request.unknown_is_occupied)
        origin: messages.Point = tuple(found.origin_m.tolist())
        return messages.DistanceAnswer(
            **self._about(snapshot),
            origin_m=origin,
            voxel_size_m=found.voxel_size_m,
            distance_m=found.distance_m,
            state=found.state,
        )

    def _changes(self, snapshot: MapSnapshot, request: messages.ChangesRequest) -> messages.Answer:
        since = request.since if request.map_id in ("", self.map_id) else 0
        found = snapshot.changes(since, min(request.limit or MAX_CHANGED_BLOCKS, MAX_CHANGED_BLOCKS))
        return messages.ChangesAnswer(
            map_id=self.map_id,
            version=found.version,
            epoch=found.epoch,
            since=found.since,
            newest=snapshot.version,
            scale_unknown=not found.scale_known,
            **_arrays(found, messages.ChangesAnswer),
        )


def _to_error(error: SemanticMapperError | MemoryError) -> SemanticMapperError:
    if isinstance(error, MemoryError):
        return MapError("the mapper has no memory left to answer this; ask for less at once")
    return error


def _arrays(found: object, kind: type[messages.Answer]) -> dict[str, Any]:
    """Arrays of an answer; what is optional is left out where it says nothing."""
    values = {name: getattr(found, name) for name in messages.array_forms(kind) if name != "computed"}
    return values | {"computed": _computed(found)}


def _computed(found: object) -> UInt8 | None:
    """Where no sensor measured the surface that was found; None = nowhere."""
    match found:
        case PointAnswers(distance_m=distance_m, measured=measured) if measured is not None:
            computed = np.isfinite(distance_m) & ~measured
        case RayHits(distance_m=distance_m, measured=measured) if measured is not None:
            computed = (distance_m > 0) & ~measured
        case MapPoints(measured=measured) if measured is not None:
            computed = ~measured
        case BlockChanges(computed=computed) if computed is not None:
            pass
        case _:
            return None
    return computed.astype(np.uint8) if computed.any() else None


def _thing_arrays(things: Sequence[Instance], *, gone: bool) -> dict[str, Any]:
    measured = [t.measured for t in things]
    numbers = [(t.id, t.class_id, len(t.voxels)) for t in things]
    places = [
        np.concatenate(([t.confidence], t.centroid, t.box.center, t.box.size, t.box.R_world_box.ravel()))
        for t in things
    ]
    return {
        "numbers": np.array(numbers, np.int64).reshape(-1, 3),
        "places": np.array(places, np.float64).reshape(-1, 19),
        "voxels": np.concatenate([np.empty((0, 3), np.int32), *(t.voxels for t in things)]),
        "measured": np.array(measured) if gone or min(measured, default=1.0) < 1 else None,
        "gone_ns": np.array([-1 if t.gone_ns is None else t.gone_ns for t in things], np.int64) if gone else None,
    }


def _takes_long(snapshot: MapSnapshot, request: messages.Request) -> bool:
    match request:
        case messages.AtRequest():
            return _visited_voxels(snapshot, request) > LONG_VISITED_VOXELS
        case messages.RaysRequest():
            return _ray_count(request) * request.max_m > LONG_RAY_METRES
        case messages.OccupancyRequest():
            return len(request.points) > LONG_POINTS
        case messages.BoxRequest() | messages.DistanceRequest():
            return math.prod(_box_sides(snapshot, request)) > LONG_BOX_VOXELS
        case messages.InstancesRequest() | messages.ChangesRequest() | messages.CorrectPosesRequest():
            return True
        case _:
            return False


def _box_sides(snapshot: MapSnapshot, request: messages.BoxRequest | messages.DistanceRequest) -> list[float]:
    return [(b - a) / snapshot.voxel_size_m for a, b in zip(request.lower, request.upper, strict=True)]


def _visited_voxels(snapshot: MapSnapshot, request: messages.AtRequest) -> float:
    radius = RADIUS_VOXELS if request.radius_m is None else request.radius_m / snapshot.voxel_size_m
    return len(request.points) * (2 * min(max(radius, 0), MAX_RADIUS_VOXELS) + 2) ** 3


def _bound_points(snapshot: MapSnapshot, request: messages.AtRequest) -> None:
    if _visited_voxels(snapshot, request) > MAX_VISITED_VOXELS:
        raise MapError(
            f"at: {len(request.points)} points with a radius of {request.radius_m} m are too much for one question; "
            "ask for fewer points at once, or keep a mirror"
        )


def _ray_count(request: messages.RaysRequest) -> int:
    return max(len(request.origins), len(request.directions))


def _bound_rays(request: messages.RaysRequest) -> None:
    count = _ray_count(request)
    if count * request.max_m > MAX_RAY_METRES:
        raise MapError(
            f"cast_rays: {count} rays of {request.max_m:g} m are too much for one question; at most "
            f"{MAX_RAY_METRES:g} m together, or keep a mirror"
        )
