"""Hand-held camera paths: through free space, looking at furniture."""

from __future__ import annotations

from itertools import islice

import msgspec
import numpy as np

from research.scenes.config import SUITE_VERSION, CameraPathConfig
from research.scenes.daylight import pose_of
from research.scenes.render import cast_view
from research.scenes.scene import Scene
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics, Float64

_CAMERA_STREAM = 1
_DRAWS = 160  # positions drawn to find them
_CANDIDATES = 14  # views tried at each way-point
_FINALISTS = 4  # of them are judged by the way there, too
_WAY_WEIGHT = 0.7
_TURN_WEIGHT_M = 0.35  # a turn of one radian counts as this much way
_LEG_M = 0.7  # mean way between two way-points
_SMALL_M3 = 2e-4  # eighth of the volume of a part that is worth being looked at
_LOOK_BELOW_M = 1.8  # lamps under the ceiling are no targets
_LOOK_UP_SHARE = 0.2  # of the way-points; without it ceilings are hardly seen
_CLOSE_M = (0.4, 1.1)  # of a close-up to what it looks at
_CLOSE_CLEARANCE_M = 0.15
_FINE = 24  # points of the path between two way-points
_PROBE = CameraIntrinsics(fx=27.6, fy=27.6, cx=19.5, cy=14.5, width=40, height=30)
_FLAT: dict[str, float] = dict.fromkeys(
    ("window", "curtain", "door", "picture"), 0.25
)  # little to learn from where it fills the view
_RARE: dict[str, float] = {
    **dict.fromkeys(("refrigerator", "counter", "desk"), 3.0),
    **dict.fromkeys(("toilet", "sink", "bookshelf", "table"), 2.0),
}  # few pixels in most rooms
_WORTH = np.zeros(256)  # of one pixel of each class id
for _id, _name in zip(ROOMS.ids, ROOMS.names, strict=True):
    _WORTH[_id] = 0.0 if _name in ("wall", "floor", "ceiling") else {**_FLAT, **_RARE}.get(_name, 1.0)


def camera_path(scene: Scene, count: int, seed: int, config: CameraPathConfig = CameraPathConfig()) -> Float64:
    """Poses T_world_camera (count, 4, 4) float64, OpenCV axes, deterministic in (scene, seed, config).

    The camera keeps ``config.clearance_m`` from everything, 0.15 m on a path with close-ups. Way-points are the best of
    several tried views, by how much furniture and how many classes they show. Raises ConfigError: count < 1, or
    settings that contradict each other. SemanticMapperError: where the room has no free space for a camera.
    """
    if count < 1:
        raise ConfigError(f"camera_path: count must be at least 1, got {count}")
    if not (0 < config.min_height_m <= config.max_height_m and config.step_m > 0 and config.clearance_m > 0.05):
        raise ConfigError(
            "CameraPathConfig: need 0 < min_height_m <= max_height_m, step_m > 0 and clearance_m > 0.05, got "
            f"{config.min_height_m}, {config.max_height_m}, {config.step_m} and {config.clearance_m}"
        )
    rng = np.random.default_rng((SUITE_VERSION, scene.seed, _CAMERA_STREAM, seed))
    legs = max(1, int(np.ceil(count * config.step_m / _LEG_M)))
    points = [_best_view(scene, rng, config, None)]
    for _ in range(legs):
        points.append(_best_view(scene, rng, config, points[-1]))
    fine = _smooth_path(scene, np.array(points), config)
    states = _resample(fine, count, config.step_m)
    return _with_tremor(states, rng, config)


def clearance(scene: Scene, points: Float64) -> Float64:
    """Distance (N,) of points (N, 3) to the nearest box round a primitive; negative outside the room."""
    low, high = scene.primitives.bounds()
    gap = np.maximum(np.maximum(low[None] - points[:, None], points[:, None] - high[None]), 0.0)
    nearest = np.linalg.norm(gap, axis=-1).min(1)
    inside = ((points > 0) & (points < np.array(scene.size_m))).all(1)
    return np.where(inside, nearest, -1.0)


def _best_view(scene: Scene, rng: np.random.Generator, config: CameraPathConfig, last: Float64 | None) -> Float64:
    """(5,) position, yaw, pitch of the best candidate; within reach of ``last`` in a straight line.

    ``config.close_up`` of the views look down at the nearest thing worth it, from near by.

    Of the best few, the one wins on whose way from ``last`` the picture stays worth having: no frame of bare wall.
    """
    if rng.uniform() < config.close_up and len(carried := _carried(scene)):
        return _close_up(scene, carried, rng, config, last)
    targets = _targets(scene)
    raised = rng.uniform(0.15, 0.4) if rng.uniform() < _LOOK_UP_SHARE else 0.0
    states: list[Float64] = []
    for position in _free_positions(scene, rng, config, last):
        toward = targets[int(rng.integers(len(targets)))] - position
        flat = float(np.hypot(toward[0], toward[1]))
        yaw = float(np.arctan2(toward[1], toward[0])) + rng.normal(0, 0.12)
        pitch = float(np.clip(np.arctan2(toward[2], max(flat, 0.5)), -0.7, 0.1)) + raised + rng.normal(0, 0.05)
        states.append(np.array([*position, yaw, pitch]))
    scores = np.array([_score(scene, state) for state in states])
    order = np.argsort(-scores, kind="stable")
    if last is None:
        return states[int(order[0])]
    best = max(order[:_FINALISTS], key=lambda k: scores[k] + _WAY_WEIGHT * _worst_between(scene, last, states[k]))
    return states[int(best)]


def _close_up(
    scene: Scene, targets: Float64, rng: np.random.Generator, config: CameraPathConfig, last: Float64 | None
) -> Float64:
    """(5,) position, yaw, pitch of a view from ``_CLOSE_M`` of one of ``targets`` (N >= 1, 3) that can be reached from
    ``last`` in a straight line; else the place of ``last``, turned to the nearest."""
    around = targets[rng.integers(len(targets), size=_DRAWS)]
    if last is not None:  # of three things the nearest to the camera
        rivals = targets[rng.integers(len(targets), size=(_DRAWS, 3))]
        nearest = np.linalg.norm(rivals - last[:3], axis=-1).argmin(1)
        around = rivals[np.arange(_DRAWS), nearest]
    angle, far, rise = rng.uniform(0, 2 * np.pi, _DRAWS), rng.uniform(*_CLOSE_M, _DRAWS), rng.uniform(0.35, 1.2, _DRAWS)
    out = far * np.cos(rise)
    points = around + np.stack((out * np.cos(angle), out * np.sin(angle), far * np.sin(rise)), -1)
    needed = _way_clearance(config)
    free = np.flatnonzero((clearance(scene, points) >= needed) & (points[:, 2] < 2.0))
    if last is not None:
        reach = (k for k in free if _line_is_free(scene, last[:3], points[k], needed))
        free = np.array(list(islice(reach, 1)), int)
    if len(free):
        position, target = points[free[0]], around[free[0]]
    elif last is not None:
        position, target = last[:3], targets[np.linalg.norm(targets - last[:3], axis=1).argmin()]
    else:
        return _best_view(scene, rng, msgspec.structs.replace(config, close_up=0.0), None)
    toward = target + rng.normal(0, 0.12, 3) - position
    pitch = float(np.arctan2(toward[2], np.hypot(toward[0], toward[1]))) + rng.uniform(-0.15, 0.12)
    return np.array([*position, float(np.arctan2(toward[1], toward[0])), np.clip(pitch, -1.2, 0.1)])


def _carried(scene: Scene) -> Float64:
    """(N, 3) small things that stand on furniture between knee and eye height, inside the room."""
    p = scene.primitives
    low, high = p.bounds()
    prop = p.label == ROOMS.ids[ROOMS.names.index("otherprop")]
    inside = ((p.center > 0.05) & (p.center < np.array(scene.size_m) - 0.05)).all(1)
    things = np.flatnonzero(prop & inside & (low[:, 2] > 0.3) & (low[:, 2] < 1.5) & (p.half.max(1) < 0.25))
    below = np.flatnonzero(~prop & (p.half[:, :2].min(1) > 0.14))
    gap = low[things, None, 2] - high[None, below, 2]  # N Q
    over = (p.center[things, None, :2] > low[None, below, :2]) & (p.center[things, None, :2] < high[None, below, :2])
    return p.center[things[(over.all(-1) & (np.abs(gap) < 0.03)).any(1)]]


def _worst_between(scene: Scene, a: Float64, b: Float64) -> float:
    """Lowest score of views on the straight way from state ``a`` to ``b``, turning the short way round."""
    delta = b - a
    delta[3] = (delta[3] + np.pi) % (2 * np.pi) - np.pi
    return min(_score(scene, a + fraction * delta) for fraction in (0.33, 0.67))


def _targets(scene: Scene) -> Float64:
    """(N >= 1, 3) one point to look at for each object, more for furniture that is rare in pictures; those of little
    worth, and small things, only where there is nothing else."""
    worth, volume = _WORTH[scene.primitives.label], scene.primitives.half.prod(1)
    low = scene.primitives.center[:, 2] < _LOOK_BELOW_M
    for least, size in ((1.0, _SMALL_M3), (1.0, 0.0), (0.1, 0.0)):
        things = np.flatnonzero((worth >= least) & low & (volume >= size))
        if len(things):
            first = things[np.unique(scene.primitives.instance[things], return_index=True)[1]]
            return scene.primitives.center[np.repeat(first, np.maximum(worth[first], 1.0).astype(int))]
    return np.array([scene.size_m]) / 2


def _free_positions(scene: Scene, rng: np.random.Generator, config: CameraPathConfig, last: Float64 | None) -> Float64:
    """(N >= 1, 3) candidate positions."""
    w, d, _ = scene.size_m
    low = np.array([config.clearance_m, config.clearance_m, config.min_height_m])
    high = np.maximum(low, [w - config.clearance_m, d - config.clearance_m, config.max_height_m])
    if last is None:
        points = rng.uniform(low, high, (_DRAWS, 3))
    else:
        reach = rng.uniform(0.3, 1.9, (_DRAWS, 1)) * _LEG_M
        angle = rng.uniform(0, 2 * np.pi, _DRAWS)
        step = np.stack((np.cos(angle), np.sin(angle), rng.normal(0, 0.15, _DRAWS)), -1)
        points = np.clip(last[:3] + step * reach, low, high)
    room = clearance(scene, points)
    if last is None and room.max() < config.clearance_m:
        raise SemanticMapperError(
            f"room {scene.seed}: no place is {config.clearance_m} m from everything at camera height; "
            "lower CameraPathConfig.clearance_m, or furnish less"
        )
    free = points[room >= config.clearance_m]
    if last is not None:
        reachable = (p for p in free if _line_is_free(scene, last[:3], p, _way_clearance(config)))
        free = np.array(list(islice(reachable, _CANDIDATES))).reshape(-1, 3)
    if not len(free) and last is not None:
        return last[None, :3]
    return free[:_CANDIDATES]


def _way_clearance(config: CameraPathConfig) -> float:
    """Between way-points; paths with close-ups come nearer to things."""
    return min(config.clearance_m, _CLOSE_CLEARANCE_M) if config.close_up > 0 else config.clearance_m


def _line_is_free(scene: Scene, a: Float64, b: Float64, needed: float) -> bool:
    fraction = np.linspace(0, 1, 12)[:, None]
    return bool((clearance(scene, a + fraction * (b - a)) >= needed - 1e-9).all())


def _score(scene: Scene, state: Float64) -> float:
    """How much furniture, and of how many classes, a view shows; very near things count against it."""
    depth, index = cast_view(scene, _PROBE, pose_of(state[:3], state[3], state[4]))
    label = scene.primitives.label[index]
    worth = _WORTH[label]
    classes = np.unique(label[worth > 0], return_counts=True)[1]
    near = float((depth < 0.8).mean())
    return min(float(np.minimum(worth, 1.7).mean()), 0.5) * 2.5 + 0.15 * float((classes > 8).sum()) - 1.5 * near


def _smooth_path(scene: Scene, points: Float64, config: CameraPathConfig) -> Float64:
    """(N, 5) way-points -> fine path: Catmull-Rom where that keeps clear of things, else straight legs."""
    points = points.copy()
    points[:, 3] = np.unwrap(points[:, 3])
    padded = np.vstack((points[:1], points, points[-1:]))
    legs: list[Float64] = []
    t = np.linspace(0, 1, _FINE, endpoint=False)[:, None]
    needed = _way_clearance(config)
    for k in range(len(points) - 1):
        a, b, c, d = padded[k : k + 4]
        curve = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        if clearance(scene, curve[:, :3]).min() < needed:
            curve[:, :3] = b[:3] + t * (c - b)[:3]
        legs.append(curve)
    return np.vstack((*legs, points[-1:]))


def _resample(fine: Float64, count: int, step_m: float) -> Float64:
    """(count, 5) states, evenly spaced in way and turn along the path, ``step_m`` apart where it is long enough."""
    delta = np.diff(fine, axis=0)
    way = np.hypot(np.linalg.norm(delta[:, :3], axis=1), _TURN_WEIGHT_M * np.hypot(delta[:, 3], delta[:, 4]))
    along = np.concatenate(([0.0], np.cumsum(way)))
    wanted = np.linspace(0, min(step_m * (count - 1), along[-1]), count)
    return np.stack([np.interp(wanted, along, fine[:, i]) for i in range(5)], -1)


def _with_tremor(states: Float64, rng: np.random.Generator, config: CameraPathConfig) -> Float64:
    """Poses of the states, shaken by a mean-reverting random walk."""
    keep = 0.8
    shake = rng.standard_normal((len(states), 6))
    for k in range(1, len(states)):
        shake[k] = keep * shake[k - 1] + np.sqrt(1 - keep**2) * shake[k]
    shift = np.clip(shake[:, :3], -3, 3) * config.tremor_m
    turn = np.radians(config.tremor_deg) * shake[:, 3:]
    turn[:, 2] += np.radians(config.roll_deg)
    return np.array(
        [
            pose_of(state[:3] + shift[k], state[3] + turn[k, 0], state[4] + turn[k, 1], turn[k, 2])
            for k, state in enumerate(states)
        ]
    )
