"""A deck above the ground, seen from a ring of cameras: a scene that only its geometry tells apart."""

import numpy as np

from semantic_mapper.labels import make_label_set
from semantic_mapper.rays import pixel_grid
from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
HEIGHTS = make_label_set("heights", ["ground", "deck"])
BOX_M = (-2.0, -2.0, -0.5, 2.0, 2.0, 2.0)  # that holds both


def look_down(azimuth: float) -> np.ndarray:
    """T_world_camera on a ring 3 m above the ground, looking at the middle."""
    position = np.array([1.6 * np.cos(azimuth), 1.6 * np.sin(azimuth), 3.0])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack((right, np.cross(forward, right), forward), 1)
    T[:3, 3] = position
    return T


def two_planes(azimuth: float, number: int, *, label: bool, shift: float = 0.0) -> PosedFrame:
    """A deck 0.8 m above the ground, both of one texture: only their height tells them apart.

    The deck stands ``shift`` m further along x.
    """
    T = look_down(azimuth)
    pixels = pixel_grid(64, 48).numpy().astype(np.float64)
    d = np.stack(((pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(64 * 48)), 1)
    d = d @ T[:3, :3].T
    up, down = (0.8 - T[2, 3]) / d[:, 2], -T[2, 3] / d[:, 2]
    at = T[:3, 3] + up[:, None] * d
    # On another side of the picture from elsewhere.
    deck = (np.abs(at[:, 0] - 0.8 - shift) < 0.7) & (np.abs(at[:, 1]) < 0.7)
    z = np.where(deck, up, down)
    seen = T[:3, 3] + z[:, None] * d - deck[:, None] * (shift, 0, 0)
    cell = np.floor(seen[:, :2] / 0.15).astype(np.int64)
    grey = (cell[:, 0] * 7919 + cell[:, 1] * 104729) % 97 / 97
    rgb = np.stack((grey, 0.5 + 0.5 * grey, 1 - grey), 1) * 255
    return PosedFrame(
        stamp_ns=number,
        seq=number,
        camera_id="cam",
        rgb=rgb.reshape(48, 64, 3).astype(np.uint8),
        depth_m=z.reshape(48, 64).astype(np.float32),
        label=np.where(deck, HEIGHTS.ids[1], HEIGHTS.ids[0]).reshape(48, 64).astype(np.uint8) if label else None,
        intrinsics=CAMERA,
        T_world_camera=T,
    )
