"""Pictures of a scene: the fast path (compiled, CPU). ``reference.render_view_torch`` is the plain one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes.config import NoiseConfig
from semantic_mapper.scenes.fast_cast import cast_pixels
from semantic_mapper.scenes.fast_shade import shade_pixels
from semantic_mapper.scenes.scene import Scene, kernel_arrays
from semantic_mapper.scenes.sensor_color import develop, expose
from semantic_mapper.scenes.sensor_depth import measure_depth
from semantic_mapper.scenes.shots import Shot, single_shot
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What a camera sees.

    Args:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 z-depth in metres as the sensor gives it, 0 = no measurement.
        label: (H, W) uint8 ids of ``labels.ROOMS``, its ignore id where nothing was hit.
        instance: (H, W) uint16, 0 where nothing was hit.
        exact_depth_m: (H, W) float32 the true z-depth, 0 = nothing hit; of a mirror, that of its surface.
    """

    rgb: UInt8
    depth_m: Float32
    label: UInt8
    instance: np.ndarray
    exact_depth_m: Float32


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """How light and depth become a ``RenderedView``.

    Args:
        seed: Of the noise.
        config: Strength of the noise.
        shot: Exposure and motion of this frame; None for a camera at rest, drawn from ``seed``.
    """

    seed: int
    config: NoiseConfig
    shot: Shot | None = None


def render_view(
    scene: Scene,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    *,
    noise: int | None = None,
    noise_config: NoiseConfig = NoiseConfig(),
    shot: Shot | None = None,
) -> RenderedView:
    """Render one view.

    Args:
        scene: From ``make_room``.
        intrinsics: Pinhole; distortion coefficients are not modelled and must be empty.
        T_world_camera: (4, 4) float64, OpenCV camera axes.
        noise: Seed of the sensor noise on colour and depth; None for a perfect camera.
        noise_config: The sensors and the strength of their noise.
        shot: Exposure and motion of this frame of a sequence; None for a camera at rest, drawn from ``noise``.

    Raises:
        PoseError: where ``T_world_camera`` is not a rigid transform.
    """
    check_pose(T_world_camera, "render_view")
    depth, index = cast_view(scene, intrinsics, T_world_camera)
    linear = shade_pixels(
        depth, index, *kernel_arrays(scene), T_world_camera[:3, 3].copy(), T_world_camera[:3, :3].copy(),
        intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy,
    )  # fmt: skip
    sensor = None if noise is None else Sensor(noise, noise_config, shot)
    return finish_view(scene, intrinsics, depth, index, linear, sensor)


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
    intrinsics: CameraIntrinsics,
    depth: Float64,
    index: np.ndarray,
    linear: Float32,
    sensor: Sensor | None,
) -> RenderedView:
    """Linear light (H, W, 3) and primitive numbers (H, W) -> what the sensors give; perfect ones where None."""
    label = np.append(scene.primitives.label, np.uint8(ROOMS.ignore_id))[index]  # index -1 is the appended entry
    instance = np.append(scene.primitives.instance, np.uint16(0))[index]
    exact = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    if sensor is None:
        return RenderedView(develop(linear), exact.copy(), label, instance, exact)
    rng = np.random.default_rng(sensor.seed)
    shot = sensor.shot or single_shot(sensor.seed, sensor.config)
    rgb = expose(linear, exact, intrinsics, shot, sensor.config, rng)
    depth_m = measure_depth(exact, rgb, intrinsics, sensor.config.depth, rng)
    return RenderedView(rgb, depth_m, label, instance, exact)
