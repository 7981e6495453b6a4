"""Places seen so far: which of them an image shows, and what a map keeps of its own. Matches are counted with each
place in turn (1 ms each), which is exact and needs no vocabulary."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np

from semantic_mapper.localization.features import Features, match_features
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

DESCRIPTOR_BYTES = 128
MAX_PLACES = 300  # that a map keeps
MAX_FEATURES = 400  # of each: 140 bytes a feature

_maker = ThreadPoolExecutor(1, "places")
_SPACING_M, _SPACING_RAD = 0.2, np.deg2rad(12.0)  # a view this far from all places is a new one


def rank_places(features: Features, descriptors: Mapping[int, UInt8], count: int) -> list[tuple[int, int]]:
    """The places most like an image, best first, at most ``count``, as (key, number of features that match, at least
    one); ``descriptors`` are (N, 128) of each place, by key."""
    scored = [(key, len(match_features(features.descriptors, theirs))) for key, theirs in descriptors.items()]
    scored.sort(key=lambda item: -item[1])
    return [(key, score) for key, score in scored[:count] if score > 0]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """What a map keeps of a view to find itself by."""

    camera_id: str
    stamp_ns: int
    T_world_camera: Float64  # (4, 4) float64
    points: Float32  # (N, 3) float32 features in the camera's axes, metres
    descriptors: UInt8  # (N, 128) uint8


def make_place(
    camera_id: str, stamp_ns: int, T_world_camera: Float64, features: Features, intrinsics: CameraIntrinsics
) -> Place:
    """A place of the features that have depth."""
    deep = np.flatnonzero(features.depth_m > 0)[:MAX_FEATURES]
    points = features.points(intrinsics)[deep].astype(np.float32)
    return Place(camera_id, stamp_ns, T_world_camera.copy(), points, features.descriptors[deep])


def shared_places(ours: Iterable[Place], theirs: Iterable[Place]) -> int:
    """How many places are of the same frame in both: its camera, stamp and features."""
    known = {(p.camera_id, p.stamp_ns): p.descriptors for p in ours}
    same = ((known.get((p.camera_id, p.stamp_ns)), p.descriptors) for p in theirs)
    return sum(a is not None and len(a) > 0 and np.array_equal(a, b) for a, b in same)


class PlaceStore:
    """The places of a map, oldest first; beyond ``capacity`` the younger of the two nearest to each other goes.

    Any thread may call it. What needs a place that is in the making waits for it: all is as if it had been added."""

    def __init__(self, places: Iterable[Place] = (), capacity: int = MAX_PLACES) -> None:
        self._known = list(places)
        self._making: Future[Place] | None = None  # the newest
        self._poses = [place.T_world_camera for place in self._known]  # and of the newest
        self._capacity = capacity
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def places(self) -> tuple[Place, ...]:
        """All, oldest first."""
        with self._lock:
            return tuple(self._made())

    def wants(self, T_world_camera: Float64) -> bool:
        """Whether a view from this pose is a new place."""
        with self._lock:
            return bool((_apart(np.reshape(self._poses, (-1, 4, 4)), T_world_camera) > 1).all())

    def add(self, place: Place) -> None:
        """Keep a place."""
        with self._lock:
            self._made().append(place)
            self._note(place.T_world_camera)

    def add_soon(self, T_world_camera: Float64, make: Callable[[], Place]) -> None:
        """Keep the place of a pose, which a thread makes while the caller goes on; its error comes at the next call."""
        with self._lock:
            self._made()
            self._making = _maker.submit(make)
            self._note(T_world_camera)

    def move(self, poses: Mapping[tuple[str, int], Float64]) -> None:
        """Give places other poses, by (camera_id, stamp_ns); those that are not named stay where they are."""
        with self._lock:
            moved = [(p, poses.get((p.camera_id, p.stamp_ns))) for p in self._made()]
            self._known = [p if pose is None else replace(p, T_world_camera=pose.copy()) for p, pose in moved]
            self._poses = [p.T_world_camera for p in self._known]

    def _made(self) -> list[Place]:
        """All, when the newest is made."""
        if self._making is not None:
            if (error := self._making.exception()) is not None:
                self._making = None
                del self._poses[-1]
                raise error
            self._known.append(self._making.result())
            self._making = None
        return self._known

    def _note(self, T_world_camera: Float64) -> None:
        self._poses.append(T_world_camera)
        if len(self._poses) > self._capacity:
            poses = np.stack(self._poses[:-1])  # never the newest
            one = most_crowded(_apart(poses[:, None], poses[None]))[1]
            del self._known[one], self._poses[one]


def view_distances(T_world_a: Float64, T_world_b: Float64) -> tuple[Float64, Float64]:
    """Metres and radians between poses (..., 4, 4)."""
    way = np.linalg.norm(T_world_a[..., :3, 3] - T_world_b[..., :3, 3], axis=-1)
    cosine = ((T_world_a[..., :3, :3] * T_world_b[..., :3, :3]).sum(axis=(-2, -1)) - 1) / 2
    return way, np.arccos(np.clip(cosine, -1, 1))


def most_crowded(apart: Float64) -> tuple[int, int]:
    """Of views in their order, the older and the younger of the two that are nearest by their distances (N, N)."""
    below = np.where(np.tri(len(apart), k=-1, dtype=bool), apart, np.inf)
    younger, older = divmod(int(below.argmin()), len(apart))
    return older, younger


def _apart(T_world_a: Float64, T_world_b: Float64) -> Float64:
    """Distances of views (..., 4, 4) in spacings."""
    way, turn = view_distances(T_world_a, T_world_b)
    return np.maximum(way / _SPACING_M, turn / _SPACING_RAD)
