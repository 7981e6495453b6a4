"""A camera before a slanted, textured plane: pictures with exact depth."""

import cv2
import numpy as np

from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
NORMAL, OFFSET_M = np.array([0.25, 0.1, 1.0]), 2.0  # points p with NORMAL @ p = OFFSET_M
_TEXTURE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (512, 512)).astype(np.float32), (0, 0), 1.2)
_TEXTURE = cv2.normalize(_TEXTURE, None, 0, 255, cv2.NORM_MINMAX)


def plane_frame(
    x: float = 0.0,
    y: float = 0.0,
    *,
    turn: float = 0.0,
    seq: int = 0,
    camera_id: str = "cam",
    gain: float = 1.0,
    camera: CameraIntrinsics = CAMERA,
) -> tuple[PosedFrame, np.ndarray]:
    """Frame without depth, of a camera at (x, y, 0) that is turned about its y axis; and its exact depth."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
    pose[:3, 3] = x, y, 0
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)), -1) @ pose[:3, :3].T
    depth = (OFFSET_M - NORMAL @ pose[:3, 3]) / (rays @ NORMAL)
    p = pose[:3, 3] + rays * depth[..., None]
    at = (p[..., :2] * 50 + 256).astype(np.float32)
    gray = cv2.remap(_TEXTURE, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    rgb = np.repeat(np.clip(gray * gain, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    frame = PosedFrame((seq + 1) * 100_000_000, seq, camera_id, rgb, None, None, camera, pose)
    return frame, depth.astype(np.float32)
