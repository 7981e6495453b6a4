"""Light under an open sky: one sun with a shadow map, the sky's own light, and what rays that miss everything see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.fast_cast import cast_pixels
from research.scenes.materials import Color
from research.scenes.primitives import Primitives, rotation_x, rotation_z
from semantic_mapper.geometry import expect_shape, invert_pose, transform
from semantic_mapper.types import Float32, Float64

_TINT = np.array([0.9, 0.97, 1.1])  # of what the sky lights
_SKY_GAIN = np.float32(1.15)
_CLOUD_LIGHT = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Daylight:
    """Sun and sky. The sun sends white light of strength 1.

    Args:
        miss_label: Class of what rays that hit nothing see; None where the label set has none for the sky.
        sun: (3,) unit vector towards it.
        shadow: (S, S) float32 depth of the first surface as a camera in the sun sees it, from so far away that its rays
            are as good as parallel.
        T_world_sun: (4, 4) pose of that camera.
        sun_focal: Its focal length, pixels.
        bias_m: What lies this much deeper than ``shadow`` is shaded.
        shade: Light of the sky on a surface, as a fraction of the sun's.
        sky: Linear RGB at the horizon and at the zenith.
        clouds: (S, S) float32 in [0, 1], cover of the sky; tiles. None = a clear sky.
        haze_m: Way after which 1/e of a surface's light is left; inf = no haze.
    """

    miss_label: str | None
    sun: Float64
    shadow: Float32
    T_world_sun: Float64
    sun_focal: float
    bias_m: float
    shade: float
    sky: tuple[Color, Color]
    clouds: Float32 | None = None
    haze_m: float = np.inf


def sun_camera(middle: Float64, azimuth: float, elevation: float, distance_m: float) -> tuple[Float64, Float64]:
    """Unit vector (3,) towards the sun, and T_world_sun (4, 4) of a camera there that looks at ``middle`` (3,)."""
    flat = np.cos(elevation)
    sun = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
    return sun, pose_of(middle + sun * distance_m, azimuth + np.pi, -elevation)


def pose_of(position: Float64, yaw: float, pitch: float, roll: float = 0.0) -> Float64:
    """T_world_camera (4, 4) of a camera looking along ``yaw`` (about z, 0 = x axis), raised by ``pitch``, radians."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera axes for yaw 0: z ahead, y down
    T = np.eye(4)
    T[:3, :3] = rotation_z(yaw) @ level @ rotation_x(pitch) @ rotation_z(roll)
    T[:3, 3] = position
    return T


def shadow_map(primitives: Primitives, T_world_sun: Float64, focal: float, size: int) -> Float32:
    """(size, size) float32 depth of what the sun's camera sees; inf where nothing."""
    p, middle = primitives, size / 2 - 0.5
    origin, axes = T_world_sun[:3, 3].copy(), T_world_sun[:3, :3].copy()
    camera = (origin, axes, focal, focal, middle, middle, size, size)
    return cast_pixels(p.shape, p.center, p.half, p.rotation, *camera)[0].astype(np.float32)


def lit_by_day(
    daylight: Daylight, lit: Float32, normal: Float64, depth: Float64, rays: Float64, origin: Float64
) -> Float32:
    """Linear RGB (H, W, 3) of what a camera sees by day.

    Args:
        daylight: Sun and sky.
        lit: (H, W, 3) of ``shade_pixels`` by ambient light of strength 1 alone.
        normal: (H, W, 3) of the surfaces.
        depth: (H, W) along the camera's z, inf where nothing was hit.
        rays: (H, W, 3) from the camera, world axes, 1 along its z.
        origin: (3,) of the camera.
    """
    expect_shape(rays, f"{depth.shape[0]} {depth.shape[1]} 3", "rays")
    hit = np.isfinite(depth)
    distance = np.where(hit, depth, 0.0)
    world = origin + distance[..., None] * rays
    albedo = lit / (0.75 + 0.25 * normal[..., 2:])  # that is how ``shade_pixels`` lights what has no lamp
    facing = np.clip(normal @ daylight.sun, 0, 1)[..., None] * _sunlit(daylight, world)[..., None]
    light = daylight.shade * (0.7 + 0.3 * normal[..., 2:]) * _TINT + facing
    clear = np.exp(-distance / daylight.haze_m)[..., None]
    surface = (clear * albedo * light + (1 - clear) * np.array(daylight.sky[0])).astype(np.float32)
    return np.where(hit[..., None], surface, _sky_light(daylight, rays))


def _sky_light(daylight: Daylight, rays: Float64) -> Float32:
    """Linear RGB (H, W, 3) of the sky along rays (H, W, 3)."""
    up = np.clip(rays[..., 2] / np.linalg.norm(rays, axis=-1), 0.0, 1.0)
    blend = np.clip(up * 2.2, 0, 1)[..., None] ** 0.7
    light = (1 - blend) * np.array(daylight.sky[0]) + blend * np.array(daylight.sky[1])
    if daylight.clouds is None:
        return light.astype(np.float32) * _SKY_GAIN
    size = len(daylight.clouds)
    plane = rays[..., :2] / np.maximum(rays[..., 2:], 0.05) * 60  # clouds hang in a plane
    row, column = (np.floor(plane).astype(int) % size).transpose(2, 0, 1)
    cover = daylight.clouds[row, column][..., None] * np.clip(up * 6, 0, 1)[..., None]
    return ((1 - cover) * light + cover * _CLOUD_LIGHT).astype(np.float32) * _SKY_GAIN


def _sunlit(daylight: Daylight, world: Float64) -> Float64:
    """(H, W) 1 where the sun reaches, 0 in shadow; points outside the shadow map are lit."""
    q = transform(invert_pose(daylight.T_world_sun), world.reshape(-1, 3))
    size = len(daylight.shadow)
    uv = np.rint(q[:, :2] / q[:, 2:] * daylight.sun_focal + (size / 2 - 0.5)).astype(int)
    inside = np.asarray(((uv >= 0) & (uv < size)).all(axis=1))
    column, row = np.where(inside[:, None], uv, 0).T
    shaded = inside & (daylight.shadow[row, column] <= q[:, 2] - daylight.bias_m)
    return (1.0 - shaded.astype(np.float64)).reshape(world.shape[:2])
