"""Pictures of a scene: the fast path (compiled, CPU). ``reference.render_view_torch`` is the plain one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.config import NoiseConfig
from research.scenes.daylight import lit_by_day
from research.scenes.fast_cast import cast_pixels
from research.scenes.fast_shade import shade_pixels, surface_normals
from research.scenes.scene import Scene, kernel_arrays
from research.scenes.sensor_color import develop, expose
from research.scenes.sensor_depth import measure_depth
from research.scenes.shots import Shot, single_shot
from research.scenes.veneer import veneered
from semantic_mapper.geometry import check_pose
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What a camera sees.

    Args:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 z-depth in metres as the sensor gives it, 0 = no measurement.
        label: (H, W) uint8 ids of the scene's label set; where nothing was hit that of the sky, if it has one, or the
            ignore id.
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

    Raises PoseError: where ``T_world_camera`` is not a rigid transform.

    Args:
        scene: From ``make_room`` or another suite.
        intrinsics: Pinhole; distortion coefficients are not modelled and must be empty.
        T_world_camera: (4, 4) float64, OpenCV camera axes.
        noise: Seed of the sensor noise on colour and depth; None for a perfect camera.
        noise_config: The sensors and the strength of their noise.
        shot: Exposure and motion of this frame of a sequence; None for a camera at rest, drawn from ``noise``.
    """
    check_pose(T_world_camera, "render_view")
    depth, index = cast_view(scene, intrinsics, T_world_camera)
    linear = light_seen(scene, intrinsics, T_world_camera, depth, index)
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


def light_seen(
    scene: Scene, intrinsics: CameraIntrinsics, T_world_camera: Float64, depth: Float64, index: np.ndarray
) -> Float32:
    """Linear RGB (H, W, 3) float32 of what ``cast_view`` found; of misses that of the sky, black indoors."""
    i = intrinsics
    primitives, materials, lights = kernel_arrays(scene)
    camera = (T_world_camera[:3, 3].copy(), T_world_camera[:3, :3].copy(), i.fx, i.fy, i.cx, i.cy)
    lit = shade_pixels(depth, index, primitives, materials, lights, *camera)
    if scene.daylight is None and scene.veneer is None:
        return lit
    normal = surface_normals(depth, index, primitives, *camera)
    if scene.veneer is not None:
        hit = index >= 0
        points = camera[0] + camera_rays(i, T_world_camera)[hit] * depth[hit, None]
        material = scene.primitives.material[index[hit]]
        lit[hit] = veneered(scene.veneer, lit[hit], normal[hit], points, material)
    if scene.daylight is None:
        return lit
    return lit_by_day(scene.daylight, lit, normal, depth, camera_rays(i, T_world_camera), camera[0])


def camera_rays(intrinsics: CameraIntrinsics, T_world_camera: Float64) -> Float64:
    """(H, W, 3) float64 directions of all pixels in world axes, 1 along the camera's z."""
    i = intrinsics
    u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
    return np.stack(((u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)), axis=-1) @ T_world_camera[:3, :3].T


def seen_labels(scene: Scene, index: np.ndarray) -> UInt8:
    """Ids (H, W) of the primitives ``index`` (H, W), -1 = nothing was hit."""
    sky = None if scene.daylight is None else scene.daylight.miss_label
    nothing = scene.label_set.ignore_id if sky is None else scene.label_set.id_of(sky)
    return np.append(scene.primitives.label, np.uint8(nothing))[index]  # index -1 is the appended entry


def finish_view(
    scene: Scene,
    intrinsics: CameraIntrinsics,
    depth: Float64,
    index: np.ndarray,
    linear: Float32,
    sensor: Sensor | None,
) -> RenderedView:
    """Linear light (H, W, 3) and primitive numbers (H, W) -> what the sensors give; perfect ones where None."""
    label = seen_labels(scene, index)
    instance = np.append(scene.primitives.instance, np.uint16(0))[index]
    exact = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    if sensor is None:
        return RenderedView(develop(linear), exact.copy(), label, instance, exact)
    rng = np.random.default_rng(sensor.seed)
    shot = sensor.shot or single_shot(sensor.seed, sensor.config)
    rgb = expose(linear, exact, intrinsics, shot, sensor.config, rng)
    depth_m = measure_depth(exact, rgb, intrinsics, sensor.config.depth, rng)
    return RenderedView(rgb, depth_m, label, instance, exact)
