"""Pictures of a scene: the fast path (compiled, CPU). ``reference.render_view_torch`` is the plain one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes.config import NoiseConfig
from semantic_mapper.scenes.fast_cast import cast_pixels
from semantic_mapper.scenes.fast_shade import shade_pixels
from semantic_mapper.scenes.noise import add_noise
from semantic_mapper.scenes.scene import Scene
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What a camera sees.

    Args:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 z-depth in metres, 0 = nothing hit, or a hole of the noise model.
        label: (H, W) uint8 ids of ``labels.ROOMS``, its ignore id where nothing was hit.
        instance: (H, W) uint16, 0 where nothing was hit.
    """

    rgb: UInt8
    depth_m: Float32
    label: UInt8
    instance: np.ndarray


def render_view(
    scene: Scene,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    *,
    noise: int | None = None,
    noise_config: NoiseConfig = NoiseConfig(),
) -> RenderedView:
    """Render one view.

    Args:
        scene: From ``make_room``.
        intrinsics: Pinhole; distortion coefficients are not modelled and must be empty.
        T_world_camera: (4, 4) float64, OpenCV camera axes.
        noise: Seed of the sensor noise on colour and depth; None for a perfect camera.
        noise_config: Strength of that noise.

    Raises:
        PoseError: where ``T_world_camera`` is not a rigid transform.
    """
    check_pose(T_world_camera, "render_view")
    depth, index = cast_view(scene, intrinsics, T_world_camera)
    prim, mat, light = scene.primitives, scene.materials, scene.lights
    linear = shade_pixels(
        depth, index, prim.shape, prim.center, prim.half, prim.rotation, prim.material,
        mat.pattern, mat.color_a, mat.color_b, mat.scale_m, mat.seed, mat.emission, mat.gloss,
        light.position, light.color, light.shadow, light.ambient,
        T_world_camera[:3, 3].copy(), T_world_camera[:3, :3].copy(),
        intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy,
    )  # fmt: skip
    return finish_view(scene, depth, index, linear, noise, noise_config)


def cast_view(scene: Scene, intrinsics: CameraIntrinsics, T_world_camera: Float64) -> tuple[Float64, np.ndarray]:
    """Depth (H, W) float64 (inf = miss) and primitive number (H, W) int32 (-1 = miss), without colour."""
    prim = scene.primitives
    return cast_pixels(
        prim.shape, prim.center, prim.half, prim.rotation,
        T_world_camera[:3, 3].copy(), T_world_camera[:3, :3].copy(),
        intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.width, intrinsics.height,
    )  # fmt: skip


def finish_view(
    scene: Scene,
    depth: Float64,
    index: np.ndarray,
    linear: Float32,
    noise: int | None,
    noise_config: NoiseConfig,
) -> RenderedView:
    """Linear light and primitive numbers -> what the sensor gives."""
    label = np.append(scene.primitives.label, np.uint8(ROOMS.ignore_id))[index]  # index -1 is the appended entry
    instance = np.append(scene.primitives.instance, np.uint16(0))[index]
    depth_m = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    if noise is None:
        return RenderedView(_DISPLAY.encode(linear), depth_m, label, instance)
    linear, depth_m, grain = add_noise(linear, depth_m, noise, noise_config)
    rgb = np.clip(_DISPLAY.encode(linear) + grain, 0, 255).astype(np.uint8)
    return RenderedView(rgb, depth_m, label, instance)


class _Display:
    """Linear light -> 8-bit grey levels by table: highlights roll off, gamma 2.2."""

    _SIZE = 4096
    _TOP = 4.0  # linear light that the table ends at

    def __init__(self) -> None:
        x = np.linspace(0.0, 1.0, self._SIZE) ** 2 * self._TOP
        rolled = x * (1.0 + x / 9.0) / (1.0 + x)  # Reinhard with white at 3
        self._table = np.clip(rolled ** (1 / 2.2) * 255.0 + 0.5, 0, 255).astype(np.uint8)

    def encode(self, linear: Float32) -> UInt8:
        """(...) float -> (...) uint8."""
        position = np.sqrt(np.clip(linear, 0.0, self._TOP) / self._TOP) * (self._SIZE - 1)
        return self._table[(position + 0.5).astype(np.int32)]


_DISPLAY = _Display()
