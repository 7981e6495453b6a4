"""Which way is up in a model, and how large it is: what structure from motion cannot tell by itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import msgspec
import numpy as np
from scipy.spatial.distance import cdist

from semantic_mapper.bundle.scale import Floor, cone
from semantic_mapper.config import MapperConfig
from semantic_mapper.drivers.lens import undistort
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.between import RegisteredFrame
from semantic_mapper.transport.messages import SCENE_DEPTH_KEY, StreamInfo
from semantic_mapper.types import Bool, CameraIntrinsics, Float64, UInt8

StructT = TypeVar("StructT", bound=msgspec.Struct)

UNSCALED_DEPTH_M = 2.0  # median depth of the points of a model whose scale nobody tells
LARGEST_RATIO = 125.0  # of a scene to one without a scale; beyond it, no setting allows the ranges
FAR_SCENE = 0.8  # of the range of the map: with a larger median depth, it would leave out half of the scene
MIN_ANGLE_DEG = 2.0  # between the rays that a place is found by
MAX_RAY_ERROR = 0.01  # a place is no further from its rays than this fraction of its distance
MIN_RAY_FRACTION = 0.5  # of the rays that must do so
MAX_RAY_PAIRS = 100  # that a place is first found by
MIN_BOARD_CORNERS = 6
FLOOR_KEY = "floor"  # metadata of a log whose floor is at z = 0: what is known of it


@dataclass(frozen=True, slots=True)
class ScaleHint:
    """What tells the size of the scene; the first of these that is given."""

    factor: float | None = None  # metres per unit of the log that comes without a scale
    board: BoardPoses | None = None  # a printed board that is seen in the film
    camera_height_m: float | None = None  # of the camera over the floor, the median over the film


def upright(T_world_first: Float64, up: Float64) -> Float64:
    """T_level_world (4, 4) of a world with z up, and the first camera at its origin, looking along x; ``up`` (3,) is a
    unit direction in the present world."""
    ahead = T_world_first[:3, 2] if abs(T_world_first[:3, 2] @ up) < 0.95 else -T_world_first[:3, 1]
    x = ahead - (ahead @ up) * up
    x /= np.linalg.norm(x)
    T_level_world = np.eye(4)
    T_level_world[:3, :3] = np.stack((x, np.cross(up, x), up))
    T_level_world[:3, 3] = -T_level_world[:3, :3] @ T_world_first[:3, 3]
    return T_level_world


def median_depth(frames: Sequence[RegisteredFrame]) -> float:
    """Of all points as their frames see them."""
    depths = [
        (frame.xyz - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, 2] for frame in frames if len(frame.xyz)
    ]
    return float(np.median(np.concatenate(depths)))


def scene_depth(depth: float) -> dict[str, str]:
    """Metadata of a log whose poses come from pictures: median depth of the points, in the unit of the poses."""
    return {SCENE_DEPTH_KEY: f"{depth:.3g}"} if depth > 0 else {}


def fit_to_scene(config: MapperConfig, info: StreamInfo) -> tuple[MapperConfig, str]:
    """Settings whose ranges fit a scene that is far larger than a room, and a sentence on it; "" = as they were.

    A setting that is not the default stays. The ratios are those at which models without a scale are mapped.
    """
    try:
        depth = float(info.metadata.get(SCENE_DEPTH_KEY, 0))
    except ValueError:  # another program's
        depth = 0.0
    if not FAR_SCENE * config.voxel_map.depth_max_m < depth < np.inf:
        return config, ""
    ratio, usual = min(depth / UNSCALED_DEPTH_M, LARGEST_RATIO), MapperConfig()

    def fitted(part: StructT, of_usual: StructT, *names: str) -> StructT:
        at_default = [name for name in names if getattr(part, name) == getattr(of_usual, name)]
        return msgspec.structs.replace(part, **{name: round(ratio * getattr(part, name), 3) for name in at_default})

    voxel_map = fitted(config.voxel_map, usual.voxel_map, "voxel_size_m", "depth_max_m")
    motion = fitted(config.depth.from_motion, usual.depth.from_motion, "near_m", "far_m")
    said = (
        f"half of the scene is beyond {depth:.3g} m: it is mapped up to {voxel_map.depth_max_m:g} m in voxels of "
        f"{voxel_map.voxel_size_m:g} m, and depth is computed from {motion.near_m:g} to {motion.far_m:g} m; "
        "voxel_map.voxel_size_m, voxel_map.depth_max_m and depth.from_motion say otherwise"
    )
    fitted_depth = msgspec.structs.replace(config.depth, from_motion=motion)
    return msgspec.structs.replace(config, voxel_map=voxel_map, depth=fitted_depth), said


def describe_floor(floor: Floor | None) -> str:
    """What is known of a floor, for people and ``FLOOR_KEY``; empty = none was found."""
    unsure = ", unsure: little of it is seen, so that the scale may be a tenth off" if floor and floor.unsure else ""
    return f"a floor of {floor.points} points{unsure}" if floor else ""


def scale_by_floor(height_m: float, below: float, floor: str) -> tuple[float, str]:
    """Metres per unit by a camera's height, which is ``below`` units over a floor of ``describe_floor``, and a sentence
    on it. Raises ImportSourceError: no floor."""
    if not floor:
        raise ImportSourceError(
            "no floor is found under the camera for its height; give a length of the map (`semantic-mapper scale RUN "
            "--known`), or film more of the floor"
        )
    return height_m / below, f"the stated camera height of {height_m:g} m over {floor}"


def triangulate(rays: Sequence[tuple[Float64, Float64]]) -> Float64 | None:
    """The place (3,) nearest to rays (origin, unit direction); None where they are too alike, or do not meet."""
    if len(rays) < 2:
        return None
    origins, directions = (np.stack(rows) for rows in zip(*rays, strict=True))
    apart = directions @ directions.T < np.cos(np.radians(MIN_ANGLE_DEG))
    if not apart.any():
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # (N, 3, 3) take what is square to each

    def nearest(rows: Any) -> Float64:
        return np.linalg.solve(across[rows].sum(axis=0), (across[rows] @ origins[rows, :, None]).sum(axis=0))[:, 0]

    def meets(place: Float64) -> Bool:
        """Which rays (N,) come near a place ahead of them."""
        off = np.linalg.norm((across @ (place - origins)[:, :, None])[:, :, 0], axis=1)
        return off < MAX_RAY_ERROR * ((place - origins) * directions).sum(axis=1)

    pairs = np.argwhere(np.triu(apart, 1))
    chosen = pairs[np.random.default_rng(0).permutation(len(pairs))[:MAX_RAY_PAIRS]]
    good = max((meets(nearest(pair)) for pair in chosen), key=lambda meeting: int(meeting.sum()))
    return nearest(good) if good.sum() >= max(2, MIN_RAY_FRACTION * len(rays)) else None


def scale_by_board(
    seen: Sequence[tuple[int, Float64, Float64]], poses: Mapping[int, Float64], intrinsics: CameraIntrinsics
) -> tuple[float, str]:
    """Metres per unit by frames with poses T_world_camera that see a board, and a sentence on how it was found.

    ``seen`` are frames, and the board's corners on the board and in the image. Raises ImportSourceError: it was not
    seen from two sides by frames that have a pose.
    """
    rays: dict[tuple[float, ...], list[tuple[Float64, Float64]]] = {}
    posed = [row for row in seen if row[0] in poses]
    for index, points, pixels in posed:
        T, slopes = poses[index], undistort(pixels, intrinsics)
        ahead = np.column_stack((slopes, np.ones(len(slopes)))) @ T[:3, :3].T
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        for point, direction in zip(points, ahead, strict=True):
            if np.isfinite(direction).all():  # not beyond the fold of a lens
                rays.setdefault(tuple(np.round(point, 6)), []).append((T[:3, 3], direction))
    corners = {corner: place for corner, of in rays.items() if (place := triangulate(of)) is not None}
    if len(corners) < MIN_BOARD_CORNERS:
        raise ImportSourceError(
            f"the board tells no scale: {len(posed)} registered frames see it (of {len(seen)}), and {len(corners)} of "
            f"its corners are seen from two sides, {MIN_BOARD_CORNERS} needed; film it larger and walk past it, or "
            "give the scale in another way"
        )
    true, found = (cdist(at, at) for at in (np.array(list(corners)), np.stack(list(corners.values()))))
    pairs = true > 0.5 * true.max()  # long ones are the most exact
    return float(np.median(true[pairs] / found[pairs])), f"a board, {len(corners)} corners in {len(posed)} frames"


MIN_LENGTH = 0.06  # of an edge, of the image's width
CONE_DEG = 40.0  # about the first guess: people hold cameras askew, and look down
TOLERANCE_DEG = 1.5  # between an edge and the direction
MIN_EDGES, MIN_SUPPORT = 40, 0.12  # of all edges' length: fewer upright ones are no evidence


def find_edges(gray: UInt8) -> Float64:
    """Straight edges (N, 4) of a picture, pixels u v u v."""
    found = cv2.createLineSegmentDetector().detect(gray)[0]
    if found is None:
        return np.zeros((0, 4))
    edges = np.asarray(found, np.float64).reshape(-1, 4)
    return edges[np.hypot(edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]) > MIN_LENGTH * gray.shape[1]]


def vertical(
    edges: Mapping[int, Float64], poses: Mapping[int, Float64], intrinsics: CameraIntrinsics, guess: Float64
) -> Float64 | None:
    """Up (3,) in the world by edges of some frames, their poses T_world_camera, and a rough ``guess`` (3,); None where
    too few edges agree.

    An edge and its camera span a plane, in which the edge's direction lies. The direction is sought that lies in the
    planes of most edges, by their length.
    """
    normals: list[Float64] = []
    for index, rows in edges.items():
        if index in poses and len(rows):
            flat = undistort(rows.reshape(-1, 2), intrinsics).reshape(-1, 2, 2)
            flat = flat[np.isfinite(flat).all(axis=(1, 2))]  # edges beyond the fold of a lens have no place
            rays = np.concatenate((flat, np.ones((*flat.shape[:2], 1))), axis=2)
            normals.append(np.cross(rays[:, 0], rays[:, 1]) @ poses[index][:3, :3].T)
    planes = np.concatenate([np.zeros((0, 3)), *normals])
    weight = np.linalg.norm(planes, axis=1)
    planes, weight = planes[weight > 1e-9] / weight[weight > 1e-9, None], weight[weight > 1e-9]
    if len(planes) < MIN_EDGES:
        return None

    def near(directions: Float64) -> Bool:
        """Which planes (N, D) directions (3, D) lie in."""
        return np.abs(planes @ directions) < np.sin(np.radians(TOLERANCE_DEG))

    best = guess / np.linalg.norm(guess)
    for cone_deg, step_deg in ((CONE_DEG, 1.5), (1.5, 0.25)):
        directions = cone(best, cone_deg, step_deg)
        best = directions[int(np.argmax(weight @ near(directions.T)))]
    for _ in range(5):
        agree = near(best)
        if agree.sum() < 8:
            return None
        _, axes = np.linalg.eigh((planes[agree] * weight[agree, None]).T @ planes[agree])
        best = axes[:, 0] * np.sign(axes[:, 0] @ best)
    return best if weight[near(best)].sum() > MIN_SUPPORT * weight.sum() else None
