"""A furnished room that a camera walks through, drawn in a moment: colour, depth and true poses."""

import cv2
import numpy as np

from semantic_mapper.geometry import look_at
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

SIZE_M = np.array((5.0, 4.0, 2.6))
_BOXES = 20
_TEXTURE_PX, _TEXTURE_M = 512, 2.5  # one picture for all faces, each with a part of its own


def walk_frames(
    seed: int, count: int, intrinsics: CameraIntrinsics, *, step_m: float = 0.04, noisy: bool = False
) -> tuple[PosedFrame, ...]:
    """Frames along a curve through the room of a seed; ``noisy``: with the depth of a stereo sensor."""
    rng = np.random.default_rng(seed)
    room = _Room(rng)
    start = rng.uniform(0, 2 * np.pi)
    frames = []
    for number in range(count):
        pose = _pose(start + number * step_m / 0.8)
        rgb, depth_m = room.render(pose, intrinsics)
        if noisy:
            depth_m = depth_m + (0.004 * depth_m**2 * rng.standard_normal(depth_m.shape)).astype(np.float32)
            depth_m[rng.random(depth_m.shape) < 0.03] = 0
        stamp_ns = 66_666_667 * (number + 1)
        frames.append(PosedFrame(stamp_ns, number, "cam", rgb, depth_m, None, intrinsics, pose, "drawn"))
    return tuple(frames)


def truth_of(frames: tuple[PosedFrame, ...]) -> Float64:
    """T_world_camera (N, 4, 4)."""
    return np.array([frame.T_world_camera for frame in frames])


def _pose(angle: float) -> Float64:
    middle = SIZE_M / 2
    eye = middle + np.array((0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.2 + 0.1 * np.sin(3 * angle)))
    ahead = middle + np.array((1.9 * np.cos(angle + 1.2), 1.5 * np.sin(angle + 1.2), -0.7))
    return look_at(eye, ahead, np.array((0.0, 0.0, 1.0)))


class _Room:
    """Walls, floor, ceiling, and boxes along the walls."""

    def __init__(self, rng: np.random.Generator) -> None:
        size = rng.uniform((0.4, 0.4, 0.4), (0.9, 0.9, 1.3), (_BOXES, 3))
        angle = 2 * np.pi * (np.arange(_BOXES) + rng.uniform(0, 0.6, _BOXES)) / _BOXES
        middle = SIZE_M / 2 + np.stack((2.3 * np.cos(angle), 1.85 * np.sin(angle), np.zeros(_BOXES)), axis=1)
        middle[:, 2] = np.where(np.arange(_BOXES) % 3, size[:, 2] / 2, 1.6)  # each third one hangs on the wall
        self.low, self.high = middle - size / 2, middle + size / 2
        blots = [cv2.resize(rng.integers(0, 255, (n, n, 3)).astype(np.uint8), (512, 512)) for n in (16, 32, 96)]
        self.texture = (0.3 * blots[0] + 0.35 * blots[1] + 0.35 * blots[2]).astype(np.uint8)

    def render(self, T_world_camera: Float64, k: CameraIntrinsics) -> tuple[UInt8, np.ndarray]:
        """(H, W, 3) colour and (H, W) depth."""
        u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
        rays = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)), axis=-1).reshape(-1, 3)
        ways = rays @ T_world_camera[:3, :3].T
        eye = T_world_camera[:3, 3]
        with np.errstate(divide="ignore"):
            inverse = 1 / ways
        depth = np.maximum(-eye * inverse, (SIZE_M - eye) * inverse).min(axis=1)
        face = np.zeros(len(depth), int)
        for number, (low, high) in enumerate(zip(self.low, self.high, strict=True), start=1):
            a, b = (low - eye) * inverse, (high - eye) * inverse
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (enter < leave) & (enter > 0) & (enter < depth)
            depth[hit], face[hit] = enter[hit], number
        points = eye + depth[:, None] * ways
        # Which of x, y and z is constant on the face, and the other two as coordinates of the texture.
        bounds = [(np.zeros(3), SIZE_M), *zip(self.low, self.high, strict=True)]
        low, high = (np.array([bound[i] for bound in bounds])[face] for i in (0, 1))
        axis = np.minimum(np.abs(points - low), np.abs(points - high)).argmin(axis=1)
        rows = np.arange(len(points))
        across, along = points[rows, (axis + 1) % 3], points[rows, (axis + 2) % 3]
        scale = _TEXTURE_PX / _TEXTURE_M
        shift = 97.0 * (3 * face + axis)
        shape = (k.height, k.width)
        maps = [
            np.mod(scale * c + s * shift, _TEXTURE_PX - 1).astype(np.float32).reshape(shape)
            for c, s in ((across, 1), (along, 1.7))
        ]
        rgb = cv2.remap(self.texture, *maps, cv2.INTER_LINEAR)
        return np.asarray(rgb, np.uint8), depth.reshape(shape).astype(np.float32)
