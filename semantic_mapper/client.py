"""Ask the map of a running mapper, or correct its poses, from any process."""

import threading
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike

from semantic_mapper.errors import CodecError, ShapeError, TransportError
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.floor_plan import Band, OccupancyGrid
from semantic_mapper.mapping.map_types import CameraPose, CorrectedPoses, MapPoints
from semantic_mapper.queries import questions
from semantic_mapper.queries.checks import as_numbers
from semantic_mapper.queries.find import FoundObject, find
from semantic_mapper.queries.graph import GraphTracker, SceneGraph
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
from semantic_mapper.queries.occupancy import DistanceField
from semantic_mapper.queries.questions import AnswerT, Correction, MapInfo, Point, RememberedObjects, Request, Weights
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import RayHits, costmap
from semantic_mapper.queries.text_encoder import TextEncoder
from semantic_mapper.transport.endpoints import Closing
from semantic_mapper.transport.keys import server_identity
from semantic_mapper.transport.launches import LIVE, MapperAddress, find_mapper
from semantic_mapper.transport.sockets import QuerySocket
from semantic_mapper.types import Float64, UInt8

UP = (0.0, 0.0, 1.0)
MIRROR_BLOCKS = 2000  # fetched at a time: 6 MB before compression
GRACE_S = 0.5  # in which a question that timed out is sent again, and keeps its turn

_log = get_logger(__name__)


class MapClient(Closing):
    """The queries of ``semantic_mapper.queries`` on the map of a running mapper; a context manager.

    Every call answers as the query of its name does on a snapshot, raises what that raises (``MapError``,
    ``LabelError``), and further ``CodecError`` for what cannot be sent and ``TransportError`` where nobody answers. A
    mapper that was restarted is found again. What takes or gives metres is refused (``MapError``) where the map has
    none (``MapInfo.scale_known``). Any thread may call; calls wait for each other.

    ``version`` is the version of the map that the last answer was about. Raises TransportError: no launch runs here, or
    several could be meant (names them); an invalid endpoint; or a mapper that is not among the peers.

    Args:
        place: ``live``, the one launch that runs on this machine; a launch by the name of its file ("replay") or by its
            socket folder; or the endpoint of a mapper (tcp://HOST:PORT, ipc://PATH). One that ended is looked for again
            at the next call.
        server: Name of the mapper's machine among the peers of ``keys``, as those on other machines have.
        keys: Folder of the keys (``semantic-mapper keys``); by default this user's, where a server is named.
        timeout_s, attempts: How long to wait for an answer before asking again, and how often to ask.
    """

    def __init__(
        self,
        place: str = LIVE,
        *,
        server: str = "",
        keys: Path | None = None,
        timeout_s: float = 5.0,
        attempts: int = 3,
    ) -> None:
        self._asker, self._place, self._identity = uuid.uuid4().hex, place, server_identity(server, keys)
        self._timeout_s, self._attempts = timeout_s, attempts
        self._socket_lock = threading.Lock()
        self._socket, self._closed, self._unanswered = self._connect(find_mapper(place)), False, False
        self._mirror: MapMirror | None = None
        self._mirrored = ""  # map_id of the mirror
        self._mirror_lock = threading.Lock()
        self._graphs: dict[tuple[str, Point | None], GraphTracker] = {}
        self.version = 0

    def info(self) -> MapInfo:
        """Size and classes of the map."""
        return self._ask(questions.InfoRequest())

    def at(self, points: ArrayLike, radius_m: float | None = None) -> PointAnswers:
        """What is at points (N, 3), world metres; see ``queries.nearest.at``."""
        return self._ask(questions.AtRequest(points=as_numbers(points, "points"), radius_m=radius_m))

    def nearest(
        self,
        class_name: str,
        point: ArrayLike,
        min_confidence: float = 0.0,
        *,
        unsure: bool = False,
        up: ArrayLike = UP,
    ) -> NearestSurface | None:
        """The nearest surface of a class, and the thing there, with its id of ``instances``; see
        ``queries.nearest.nearest``."""
        place, axis = _point(point, "point"), _point(up, "up")
        return self._ask(
            questions.NearestRequest(
                class_name=class_name, point=place, min_confidence=min_confidence, unsure=unsure, up=axis
            )
        )

    def cast_rays(self, origins: ArrayLike, directions: ArrayLike, max_m: float = 10.0) -> RayHits:
        """The first surface that each ray meets; see ``queries.surface.cast_rays``."""
        start = np.atleast_2d(as_numbers(origins, "origins"))
        step = np.atleast_2d(as_numbers(directions, "directions"))
        return self._ask(questions.RaysRequest(origins=start, directions=step, max_m=max_m))

    def points_in_box(self, lower: ArrayLike, upper: ArrayLike) -> MapPoints:
        """Surface points in a box; see ``queries.surface.points_in_box``."""
        return self._ask(questions.BoxRequest(lower=_point(lower, "lower"), upper=_point(upper, "upper")))

    def instances(self, up: ArrayLike = UP, *, gone: bool = False, unsure: bool = False) -> tuple[Instance, ...]:
        """Things; their ids stay from call to call, whatever is ``up``; see ``queries.instances.InstanceTracker``.

        With ``unsure``, also those of low certainty. With ``gone``, behind them also those of earlier answers that
        have gone since (``Instance.gone_ns``), the latest 64.
        """
        return self._ask(questions.InstancesRequest(up=_point(up, "up"), gone=gone, unsure=unsure))

    def graph(self, up: ArrayLike | None = None) -> SceneGraph:
        """Floors, rooms, doors and things; see ``queries.graph.GraphTracker``.

        Computed here, from ``mirror``; the things are those of ``instances``. Ids of rooms stay from call to call of
        this client, for each ``up`` ((3,), by default found by the floor); those of another client may differ.
        """
        snapshot, tracker = self._tracked(up)
        return tracker.update(snapshot, self.instances(tracker.up_in(snapshot)))

    def _tracked(self, up: ArrayLike | None) -> tuple[MapSnapshot, GraphTracker]:
        """The mirror's present state, and what knows its graph for this ``up``."""
        snapshot = self.mirror().snapshot()
        with self._mirror_lock:
            key = (self._mirrored, None if up is None else _point(up, "up"))
            return snapshot, self._graphs.setdefault(key, GraphTracker(up))

    def objects(self, up: ArrayLike | None = None) -> RememberedObjects:
        """What the map remembers of its things: their places, when they were seen, and those that have gone. It is
        brought up to the present now and then, in some 3 % of the time: ``version`` says as of when this is. ``up``
        (3,) is by default found by the floor. See ``queries.objects``."""
        return self._ask(questions.ObjectsRequest(up=None if up is None else _point(up, "up")))

    def find(
        self, phrase: str, *, limit: int = 5, up: ArrayLike | None = None, encoder: TextEncoder | None = None
    ) -> tuple[FoundObject, ...]:
        """The objects that a phrase means ("red chair near the table"), the likeliest first, and poses to look from; as
        of what ``objects`` are. An ``encoder`` scores names of things in the place of synonyms, here, where the map is
        then mirrored. See ``queries.find``."""
        axis = None if up is None else _point(up, "up")
        if encoder is None:
            return self._ask(questions.FindRequest(phrase=phrase, limit=limit, up=axis))
        objects, snapshot = self.objects(up).objects, self.mirror().snapshot()
        return find(phrase, snapshot, objects, up=self.up() if up is None else up, limit=limit, encoder=encoder)

    def up(self) -> Float64:
        """Unit vector up (3,) in the world, found by the floor once; ``MapError`` where too little of it was seen."""
        snapshot, tracker = self._tracked(None)
        return tracker.up_in(snapshot)

    def occupancy(self, points: ArrayLike) -> UInt8:
        """``State`` (N,) at points (N, 3), world metres; see ``queries.occupancy.occupancy``."""
        return self._ask(questions.OccupancyRequest(points=as_numbers(points, "points")))

    def distance_field(self, lower: ArrayLike, upper: ArrayLike, *, unknown_is_occupied: bool = False) -> DistanceField:
        """Distances to obstacles in a box; see ``queries.occupancy.distance_field``."""
        low, high = _point(lower, "lower"), _point(upper, "upper")
        return self._ask(questions.DistanceRequest(lower=low, upper=high, unknown_is_occupied=unknown_is_occupied))

    def costmap(self, radius_m: float, *, up: ArrayLike | None = None, height_m: Band | None = None) -> OccupancyGrid:
        """Where a round robot can be; computed here, from ``mirror``; see ``queries.surface.costmap``."""
        return costmap(self.mirror().snapshot(), radius_m, up=up, height_m=height_m)

    def mirror(self) -> MapMirror:
        """A mirror of the map in this process, brought up to the present; for many queries, or large ones.

        Only what has changed since the last call is fetched. The same mirror is returned again and again, and a new
        one after the mapper was restarted.
        """
        with self._mirror_lock:
            newest = -1
            while True:
                since = 0 if self._mirror is None else self._mirror.version
                request = questions.ChangesRequest(since=since, limit=MIRROR_BLOCKS, map_id=self._mirrored)
                state, changes = self._ask_about(request)
                if self._mirror is None or state.map_id != self._mirrored:
                    info = self.info()
                    self._mirror = MapMirror(info.voxel_size_m, info.truncation_voxels, info.label_set)
                    self._mirrored, newest = info.map_id, -1
                    if state.map_id != info.map_id or changes.since != 0:  # restarted between the two questions
                        continue
                self._mirror.apply(changes)
                newest = changes.newest if newest < 0 else newest  # as of the first answer: the map may outrun us
                if changes.version >= newest and self._mirror.is_whole:
                    return self._mirror

    def pose(self) -> CameraPose | None:
        """Where the last frame was taken, in the map; None before the first. ``T_map_camera`` is None, and ``reason``
        says why, while a camera's place in the map is not known."""
        return self._ask(questions.PoseRequest())

    def correct_poses(self, poses: CorrectedPoses, *, until_ns: int | None = None, within_ns: int = 0) -> Correction:
        """Begin to move the map with corrected poses, as a loop closure gives them; mapping continues meanwhile.

        The mapper begins it once, also where an answer is lost and the request is sent again.

        Raises MapError: the mapper keeps no history (``history.max_frames``), or no frame has such a stamp. PoseError:
        a pose is not a rigid transform. ShapeError: a pose is not of shape (4, 4). In every case nothing has changed.

        Args:
            poses, until_ns: As of ``MapCorrector.start``, but each pose in the world that its frame came in
                (``PosedFrame.world``), not in the map's; at most 65536 at once.
            within_ns: Poses go to the frames nearest in time, if those are so near, and are left out where none is; 0 =
                every pose must have the stamp of a frame.
        """
        keys = [key if isinstance(key, tuple) else ("", key) for key in poses]
        cameras = tuple(dict.fromkeys(camera for camera, _ in keys)) or ("",)
        matrices = [_pose(T, stamp_ns) for (_, stamp_ns), T in zip(keys, poses.values(), strict=True)]
        request = questions.CorrectPosesRequest(
            id=uuid.uuid4().hex,
            cameras=cameras,
            until_ns=until_ns,
            within_ns=within_ns,
            stamps_ns=np.array([stamp_ns for _, stamp_ns in keys], np.int64),
            camera=np.array([cameras.index(camera) for camera, _ in keys], np.int64).astype(np.uint8),
            poses=np.array(matrices).reshape(-1, 4, 4),
        )
        return self._ask(request)

    def correction(self) -> Correction:
        """How far corrections are; ``used`` and ``left_out`` are 0."""
        return self._ask(questions.CorrectionRequest())

    def weights(self) -> Weights:
        """Which weights the mapper uses; ``MapError`` where it takes none while it runs (option `learner`)."""
        return self._ask(questions.WeightsRequest())

    def close(self) -> None:
        """Free the socket. Harmless when repeated."""
        with self._socket_lock:
            self._closed = True
            self._socket.close()

    def _ask(self, request: Request[AnswerT]) -> AnswerT:
        return self._ask_about(request)[1]

    def _ask_about(self, request: Request[AnswerT]) -> tuple[questions.MapState, AnswerT]:
        """Also which map the answer is about."""
        name = questions.NAMES[type(request)]
        request = replace(request, asker=self._asker, waits_s=min(self._timeout_s + GRACE_S, questions.MAX_WAIT_S))
        parts = self._answered(questions.encode_request(name, request))
        found: tuple[questions.MapState, Any] = questions.decode_answer(name, questions.QUESTIONS[name].answer, parts)
        if request.about_map:
            self.version = found[0].version
        return found

    def _answered(self, parts: list[bytes]) -> list[bytes]:
        """The answer to a question, from the launch that is meant now: its mapper may have ended since the last one."""
        with self._socket_lock:
            path = Path(self._socket.endpoint.removeprefix("ipc://"))
            if not self._closed and (self._unanswered or (path.is_absolute() and not path.exists())):
                address = find_mapper(self._place)
                if address.endpoint != self._socket.endpoint:
                    _log.warning("another_launch_answers", before=self._socket.endpoint, now=address.endpoint)
                    self._socket.close()
                    self._socket = self._connect(address)
                self._unanswered = False
            socket = self._socket
        try:
            return socket.ask(parts)
        except TransportError:
            self._unanswered = True
            raise

    def _connect(self, address: MapperAddress) -> QuerySocket:
        identity = self._identity or address.identity
        return QuerySocket(address.endpoint, timeout_s=self._timeout_s, attempts=self._attempts, identity=identity)


def _point(values: ArrayLike, name: str) -> Point:
    """Three numbers; what they are worth the other side judges."""
    numbers = as_numbers(values, name)
    if numbers.shape != (3,):
        raise CodecError(f"{name}: expected shape (3,), got {numbers.shape}")
    x, y, z = numbers.tolist()
    return x, y, z


def _pose(T_world_camera: Float64, stamp_ns: int) -> Float64:
    """A pose as numbers; whether it is a rigid transform the other side judges."""
    what = f"corrected pose of stamp {stamp_ns}"
    pose = as_numbers(T_world_camera, what)
    if pose.shape != (4, 4):
        raise ShapeError(f"{what}: expected shape (4, 4), got {pose.shape}")
    return pose
