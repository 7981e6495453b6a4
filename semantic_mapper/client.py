"""Ask the map of a running mapper, or correct its poses, from any process of this machine."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike

from semantic_mapper.errors import CodecError, ShapeError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import CorrectedPoses, MapPoints
from semantic_mapper.mapping.storage.changes import BlockChanges
from semantic_mapper.mapping.worlds import CameraPose
from semantic_mapper.queries.checks import as_numbers
from semantic_mapper.queries.graph import GraphTracker, SceneGraph
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.lookup import PointAnswers
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import NearestSurface
from semantic_mapper.queries.occupancy import DistanceField
from semantic_mapper.queries.oriented_box import OrientedBox
from semantic_mapper.queries.rays import RayHits
from semantic_mapper.transport import query_messages as messages
from semantic_mapper.transport.codec import decode_answer, encode_request
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.keys import ServerIdentity
from semantic_mapper.transport.query_sockets import QuerySocket
from semantic_mapper.types import Bool, Float64, UInt8

UP = (0.0, 0.0, 1.0)
MIRROR_BLOCKS = 2000  # fetched at a time: 6 MB before compression

AnswerT = TypeVar("AnswerT", bound=messages.Answer)


@dataclass(frozen=True, slots=True)
class MapInfo:
    """What a map is.

    Args:
        map_id: Another one after the mapper was restarted.
        version, epoch: ``VoxelMap``'s.
        blocks: Of 8^3 voxels.
        voxel_size_m: Edge of a voxel.
        truncation_voxels: Of the TSDF.
        label_set: Its classes.
        scale_known: Whether its lengths are metres.
    """

    map_id: str
    version: int
    epoch: int
    blocks: int
    voxel_size_m: float
    truncation_voxels: float
    label_set: LabelSet
    scale_known: bool = True


@dataclass(frozen=True, slots=True)
class Correction:
    """How far the corrections of a mapper are.

    Args:
        running: A rebuild is under way; the map in use is still the old one.
        done, total: Frames of the history that the rebuild has gone through, and all.
        completed: Corrections that are in the map in use.
        poses: Given by these, all together.
        used, left_out: Poses of the request that this answers: with a frame in the history, and without.
        frozen: Frames that have left the history; corrections do not reach them.
        lost: Frames that could not be read from disk again, and so are in the map no more.
        failure: Why the last correction was given up; empty where it was not.
        epoch: Of the map in use: answers of this or a later ``MapInfo.epoch`` are about it.
    """

    running: bool
    done: int
    total: int
    completed: int
    poses: int
    used: int
    left_out: int
    frozen: int
    lost: int
    failure: str
    epoch: int


@dataclass(frozen=True, slots=True)
class Weights:
    """Which weights a mapper uses, and what became of those that it was offered.

    Args:
        in_use: Version; 0 = those that it was started with.
        before: In use before these; None where there were none.
        wanted: About to be in use; None = nothing changes.
        taken, refused, rolled_back: How often that has happened.
        versions: All that it knows of, the oldest first.
    """

    in_use: int
    before: int | None
    wanted: int | None
    taken: int
    refused: int
    rolled_back: int
    versions: tuple[messages.WeightsEntry, ...]


class MapClient:
    """The queries of ``semantic_mapper.queries`` on the map of a running mapper; a context manager.

    Every call answers as the query of its name does on a snapshot, raises what that raises (``MapError``,
    ``LabelError``), and further ``CodecError`` for what cannot be sent and ``TransportError`` where nobody answers. A
    mapper that was restarted is found again. What takes or gives metres is refused (``MapError``) where the map has
    none (``MapInfo.scale_known``). Any thread may call; calls wait for each other.

    ``version`` is the version of the map that the last answer was about.

    Args:
        endpoint: Of the mapper's query service; by default that of a mapper of this user that was started by hand.
        timeout_s: How long to wait for an answer before asking again.
        attempts: How often to ask.
        identity: Of a mapper that has keys (``transport.keys``), as those on other machines have.

    Raises:
        TransportError: an invalid endpoint, or a mapper that is not among the peers.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout_s: float = 5.0,
        attempts: int = 3,
        identity: ServerIdentity | None = None,
    ) -> None:
        self._asker, self._timeout_s = uuid.uuid4().hex, timeout_s
        self._socket = QuerySocket(
            endpoint or default_endpoint("query"), timeout_s=timeout_s, attempts=attempts, identity=identity
        )
        self._mirror: MapMirror | None = None
        self._mirrored = ""  # map_id of the mirror
        self._mirror_lock = threading.Lock()
        self._graphs: dict[tuple[str, messages.Point | None], GraphTracker] = {}
        self._labels: tuple[str, LabelSet] | None = None
        self.version = 0

    def info(self) -> MapInfo:
        """Size and classes of the map."""
        h = self._ask("info", messages.InfoAnswer, messages.InfoRequest())
        labels = h.label_set.to_label_set()
        self._labels = h.map_id, labels
        numbers = h.blocks, h.voxel_size_m, h.truncation_voxels
        return MapInfo(h.map_id, h.version, h.epoch, *numbers, labels, not h.scale_unknown)

    def at(self, points: ArrayLike, radius_m: float | None = None) -> PointAnswers:
        """What is at points (N, 3), world metres; see ``queries.lookup.at``."""
        request = messages.AtRequest(points=as_numbers(points, "points"), radius_m=radius_m)
        h = self._ask("at", messages.AtAnswer, request)
        return PointAnswers(**_arrays(h), measured=_measured(np.isfinite(h.distance_m), h.computed))

    def nearest(self, class_name: str, point: ArrayLike, min_confidence: float = 0.0) -> NearestSurface | None:
        """The nearest surface of a class; see ``queries.nearest.nearest``."""
        request = messages.NearestRequest(
            class_name=class_name, point=_point(point, "point"), min_confidence=min_confidence
        )
        h = self._ask("nearest", messages.NearestAnswer, request)
        if not h.found:
            return None
        return NearestSurface(np.array(h.xyz, np.float64), h.distance_m, h.confidence, not h.computed)

    def cast_rays(self, origins: ArrayLike, directions: ArrayLike, max_m: float = 10.0) -> RayHits:
        """The first surface that each ray meets; see ``queries.rays.cast_rays``."""
        request = messages.RaysRequest(
            origins=np.atleast_2d(as_numbers(origins, "origins")),
            directions=np.atleast_2d(as_numbers(directions, "directions")),
            max_m=max_m,
        )
        h = self._ask("cast_rays", messages.RaysAnswer, request)
        return RayHits(**_arrays(h), measured=_measured(h.distance_m > 0, h.computed))

    def points_in_box(self, lower: ArrayLike, upper: ArrayLike) -> MapPoints:
        """Surface points in a box; see ``queries.boxes.points_in_box``."""
        request = messages.BoxRequest(lower=_point(lower, "lower"), upper=_point(upper, "upper"))
        h = self._ask("points_in_box", messages.BoxAnswer, request)
        return MapPoints(**_arrays(h), measured=_measured(np.ones(len(h.xyz), np.bool_), h.computed))

    def instances(self, up: ArrayLike = UP, *, gone: bool = False) -> tuple[Instance, ...]:
        """All things; their ids stay from call to call, for each ``up``; see ``queries.instances.InstanceTracker``.

        With ``gone``, behind them also those of earlier answers that have gone since (``Instance.gone_ns``), the latest
        64.
        """
        request = messages.InstancesRequest(up=_point(up, "up"), gone=gone)
        found = self._ask("instances", messages.InstancesAnswer, request)
        return _things(found, self._label_set(found.map_id))

    def graph(self, up: ArrayLike | None = None) -> SceneGraph:
        """Floors, rooms, doors and things; see ``queries.graph.GraphTracker``.

        Computed here, from ``mirror``; the things are those of ``instances``. Ids of rooms stay from call to call of
        this client, for each ``up``; those of another client may differ.

        Args:
            up: (3,) direction in the world; found by the floor by default.
        """
        snapshot = self.mirror().snapshot()
        with self._mirror_lock:
            key = (self._mirrored, None if up is None else _point(up, "up"))
            tracker = self._graphs.setdefault(key, GraphTracker(up))
        return tracker.update(snapshot, self.instances(tracker.up_in(snapshot)))

    def occupancy(self, points: ArrayLike) -> UInt8:
        """``State`` (N,) at points (N, 3), world metres; see ``queries.occupancy.occupancy``."""
        request = messages.OccupancyRequest(points=as_numbers(points, "points"))
        return self._ask("occupancy", messages.OccupancyAnswer, request).state

    def distance_field(self, lower: ArrayLike, upper: ArrayLike, *, unknown_is_occupied: bool = False) -> DistanceField:
        """Distances to obstacles in a box; see ``queries.occupancy.distance_field``."""
        request = messages.DistanceRequest(
            lower=_point(lower, "lower"), upper=_point(upper, "upper"), unknown_is_occupied=unknown_is_occupied
        )
        h = self._ask("distance_field", messages.DistanceAnswer, request)
        return DistanceField(np.array(h.origin_m, np.float64), h.voxel_size_m, **_arrays(h))

    def mirror(self) -> MapMirror:
        """A mirror of the map in this process, brought up to the present; for many queries, or large ones.

        Only what has changed since the last call is fetched. The same mirror is returned again and again, and a new
        one after the mapper was restarted.
        """
        with self._mirror_lock:
            newest = -1
            while True:
                since = 0 if self._mirror is None else self._mirror.version
                request = messages.ChangesRequest(since=since, limit=MIRROR_BLOCKS, map_id=self._mirrored)
                h = self._ask("changes", messages.ChangesAnswer, request)
                if self._mirror is None or h.map_id != self._mirrored:
                    info = self.info()
                    self._mirror = MapMirror(info.voxel_size_m, info.truncation_voxels, info.label_set)
                    self._mirrored, newest = info.map_id, -1
                    if h.map_id != info.map_id or h.since != 0:  # restarted between the two questions
                        continue
                known, computed = not h.scale_unknown, h.computed
                versions = h.since, h.version, h.newest, h.epoch
                self._mirror.apply(BlockChanges(*versions, **_arrays(h), scale_known=known, computed=computed))
                newest = h.newest if newest < 0 else newest  # as of the first answer: the map may outrun us
                if h.version >= newest and self._mirror.is_whole:
                    return self._mirror

    def pose(self) -> CameraPose | None:
        """Where the last frame was taken, in the map; None before the first.

        Its ``T_map_camera`` is None, and ``reason`` says why, while a camera's place in the map is not known.
        """
        h = self._ask("pose", messages.PoseAnswer, messages.PoseRequest())
        if not h.camera_id:
            return None
        pose = np.array(h.T_map_camera, np.float64).reshape(4, 4) if h.T_map_camera else None
        return CameraPose(h.camera_id, h.stamp_ns, pose, h.reason)

    def correct_poses(self, poses: CorrectedPoses, *, until_ns: int | None = None, within_ns: int = 0) -> Correction:
        """Begin to move the map with corrected poses, as a loop closure gives them; the mapper goes on meanwhile.

        Asked again where an answer is lost, the mapper begins it once all the same.

        Args:
            poses, until_ns: As of ``MappingPipeline.correct_poses``, but each pose in the world that its frame came in
                (``PosedFrame.world``), not in the map's; at most 65536 at once.
            within_ns: Poses go to the frames nearest in time, if those are so near, and are left out where none is; 0 =
                every pose must have the stamp of a frame.

        Raises:
            MapError: the mapper keeps no history (``history.max_frames``), or no frame has such a stamp.
            PoseError: a pose is not a rigid transform.
            ShapeError: a pose is not of shape (4, 4).
            In every case nothing has changed.
        """
        keys = [key if isinstance(key, tuple) else ("", key) for key in poses]
        cameras = tuple(dict.fromkeys(camera for camera, _ in keys)) or ("",)
        matrices = [_pose(T, stamp_ns) for (_, stamp_ns), T in zip(keys, poses.values(), strict=True)]
        request = messages.CorrectPosesRequest(
            id=uuid.uuid4().hex,
            cameras=cameras,
            until_ns=until_ns,
            within_ns=within_ns,
            stamps_ns=np.array([stamp_ns for _, stamp_ns in keys], np.int64),
            camera=np.array([cameras.index(camera) for camera, _ in keys], np.int64).astype(np.uint8),
            poses=np.array(matrices).reshape(-1, 4, 4),
        )
        return self._correction("correct_poses", request)

    def correction(self) -> Correction:
        """How far corrections are; ``used`` and ``left_out`` are 0."""
        return self._correction("correction", messages.CorrectionRequest())

    def weights(self) -> Weights:
        """Which weights the mapper uses; ``MapError`` where it takes none while it runs (option `learner`)."""
        return self._weights(messages.WeightsRequest())

    def return_to_weights(self, version: int) -> Weights:
        """Ask the mapper to go back to weights that it has used before; it does so a moment later.

        Raises:
            MapError: it has never used these, or keeps them no longer.
        """
        return self._weights(messages.WeightsRequest(to=version))

    def close(self) -> None:
        """Free the socket. Harmless when repeated."""
        self._socket.close()

    def __enter__(self) -> MapClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, kind: str, answer: type[AnswerT], request: messages.Request) -> AnswerT:
        found = decode_answer(kind, answer, self._send(kind, request))
        self.version = found.version
        return found

    def _send(self, kind: str, request: messages.Request) -> list[bytes]:
        request = replace(request, asker=self._asker, waits_s=min(self._timeout_s, messages.MAX_WAIT_S))
        return self._socket.ask(encode_request(kind, request))

    def _correction(self, kind: str, request: messages.Request) -> Correction:
        h = decode_answer(kind, messages.CorrectionAnswer, self._send(kind, request))
        return Correction(
            running=h.running,
            done=h.done,
            total=h.total,
            completed=h.completed,
            poses=h.poses,
            used=h.used,
            left_out=h.left_out,
            frozen=h.frozen,
            lost=h.lost,
            failure=h.failure,
            epoch=h.map_epoch,
        )

    def _weights(self, request: messages.WeightsRequest) -> Weights:
        h = decode_answer("weights", messages.WeightsAnswer, self._send("weights", request))
        return Weights(
            in_use=h.in_use,
            before=h.before,
            wanted=h.wanted,
            taken=h.weights_taken,
            refused=h.weights_refused,
            rolled_back=h.weights_rolled_back,
            versions=h.entries,
        )

    def _label_set(self, map_id: str) -> LabelSet:
        if self._labels is None or self._labels[0] != map_id:
            self.info()
        assert self._labels is not None
        return self._labels[1]


def _point(values: ArrayLike, name: str) -> messages.Point:
    """Three numbers; what they are worth the other side judges.

    Raises:
        CodecError: not three.
    """
    numbers = as_numbers(values, name)
    if numbers.shape != (3,):
        raise CodecError(f"{name}: expected shape (3,), got {numbers.shape}")
    x, y, z = numbers.tolist()
    return x, y, z


def _pose(T_world_camera: Float64, stamp_ns: int) -> Float64:
    """A pose as numbers; whether it is a rigid transform the other side judges."""
    pose = as_numbers(T_world_camera, f"corrected pose of stamp {stamp_ns}")
    if pose.shape != (4, 4):
        raise ShapeError(f"corrected pose of stamp {stamp_ns}: expected shape (4, 4), got {pose.shape}")
    return pose


def _arrays(answer: messages.Answer) -> dict[str, Any]:
    """Array fields of an answer, as fields of a query's result; see ``_measured`` for what is optional."""
    forms = messages.array_forms(type(answer))
    return {name: getattr(answer, name) for name, form in forms.items() if not form.optional}


def _measured(there: Bool, computed: UInt8 | None) -> Bool:
    """Whether a sensor measured the surface that was found: N places, those ``there``."""
    return there if computed is None else there & (computed == 0)


def _things(found: messages.InstancesAnswer, labels: LabelSet) -> tuple[Instance, ...]:
    """Instances as ``instances`` answers them.

    Raises:
        CodecError: arrays that do not go together, or a class that the map does not have.
    """
    numbers, places, voxels = found.numbers, found.places, found.voxels
    sizes = numbers[:, 2]
    if len(places) != len(numbers) or (sizes < 0).any() or sizes.sum() != len(voxels):
        raise CodecError(f"instances: {len(numbers)} things, {len(places)} places and {len(voxels)} voxels disagree")
    if not np.isin(numbers[:, 1], labels.ids).all():
        raise CodecError(f"instances: of a class that label set '{labels.name}' does not have")
    names = dict(zip(labels.ids, labels.names, strict=True))
    parts: Sequence[Any] = np.split(voxels, np.cumsum(sizes)[:-1]) if len(sizes) else ()
    measured = np.ones(len(numbers)) if found.measured is None else found.measured
    if len(measured) != len(numbers):
        raise CodecError(f"instances: {len(numbers)} things, {len(measured)} of them with a measured fraction")
    gone_ns = np.full(len(numbers), -1) if found.gone_ns is None else found.gone_ns
    if len(gone_ns) != len(numbers):
        raise CodecError(f"instances: {len(numbers)} things, {len(gone_ns)} of them with when they went")
    things: list[Instance] = []
    rows = zip(numbers.tolist(), places, parts, measured.tolist(), gone_ns.tolist(), strict=True)
    for (number, class_id, _), p, part, fraction, went in rows:
        box = OrientedBox(p[4:7], p[7:10], p[10:19].reshape(3, 3))
        name, gone = names[class_id], None if went < 0 else went
        things.append(Instance(number, class_id, name, float(p[0]), p[1:4], box, part, fraction, gone))
    return tuple(things)
