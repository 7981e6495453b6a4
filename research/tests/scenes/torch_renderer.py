"""The plain torch renderer: every ray against every primitive, any device. ``render.render_view`` is the fast one.

Runs in float64 on the CPU (as the compiled path does) and in float32 elsewhere unless set otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from research.scenes.config import NoiseConfig
from research.scenes.daylight import lit_by_day
from research.scenes.fast_cast import NEAR_M
from research.scenes.fast_shade import (
    CORNER_DIM,
    CORNER_REACH_M,
    LIGHT_RADIUS_SQ,
    SHADOW_BIAS_M,
    LightArrays,
)
from research.scenes.primitives import Shape
from research.scenes.render import RenderedView, Sensor, finish_view
from research.scenes.scene import Scene, kernel_arrays
from research.scenes.shots import Shot
from research.tests.scenes.torch_textures import albedo
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import check_pose
from semantic_mapper.types import CameraIntrinsics, Float64

# As in fast_cast.h.
_PILLOW_STEPS, _PILLOW_ERROR = 10, 0.02
_TORUS_RING, _TORUS_STEPS, _TORUS_CLOSE, _TORUS_POLISH, _TORUS_ERROR = 0.7, 48, 1e-3, 5, 1e-6
_RAYS_A_CHUNK = 8192
_RAYS_A_CHUNK_GPU = 1 << 18  # about 2 GiB of temporaries with 150 primitives in float32

_LIGHT_ARRAYS = LightArrays._fields.index("low")  # what follows only speeds the compiled path up


@dataclass(frozen=True, slots=True, eq=False)
class _Tensors:
    """The scene's arrays on one device."""

    shape: torch.Tensor
    center: torch.Tensor
    half: torch.Tensor
    rotation: torch.Tensor
    material: torch.Tensor
    pattern: torch.Tensor
    color_a: torch.Tensor
    color_b: torch.Tensor
    scale_m: torch.Tensor
    seed: torch.Tensor
    emission: torch.Tensor
    gloss: torch.Tensor
    mirror: torch.Tensor
    light_position: torch.Tensor
    light_color: torch.Tensor
    shadow: torch.Tensor
    softness: torch.Tensor
    ambient: torch.Tensor
    room: torch.Tensor


def render_view_torch(
    scene: Scene,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    *,
    noise: int | None = None,
    noise_config: NoiseConfig = NoiseConfig(),
    shot: Shot | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
) -> RenderedView:
    """As ``render.render_view``, in torch operations on ``device``.

    Raises:
        PoseError: where ``T_world_camera`` is not a rigid transform.
    """
    sensors = [None if noise is None else Sensor(noise, noise_config, shot)]
    return render_views_torch(scene, intrinsics, T_world_camera[None], sensors, device=device, dtype=dtype)[0]


def render_views_torch(
    scene: Scene,
    intrinsics: CameraIntrinsics,
    poses: Float64,
    sensors: Sequence[Sensor | None],
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
) -> list[RenderedView]:
    """All views of a room in one batch of rays: a GPU is kept busy, and the scene is moved there once.

    Rays are cast and shaded on ``device``; the sensors (``render.finish_view``) run on the CPU.

    Args:
        poses: (V, 4, 4) float64 T_world_camera.
        sensors: One a view; None for a perfect camera.

    Raises:
        PoseError: where a pose is not a rigid transform.
        ConfigError: where there are not as many sensors as poses.
    """
    if len(sensors) != len(poses):
        raise ConfigError(f"render_views_torch: {len(poses)} poses but {len(sensors)} sensors; give one a pose")
    for number, pose in enumerate(poses):
        check_pose(pose, f"render_views_torch: view {number}")
    device = torch.device(device)
    dtype = dtype or (torch.float64 if device.type == "cpu" else torch.float32)
    tensors = _to_device(scene, device, dtype)
    origins, rays = _camera_rays(intrinsics, torch.as_tensor(poses, device=device, dtype=dtype))
    depths, indices, colors, normals = [], [], [], []
    chunk = _RAYS_A_CHUNK if device.type == "cpu" else _RAYS_A_CHUNK_GPU
    for origin, ray in zip(origins.split(chunk), rays.split(chunk), strict=True):
        depth, index = first_hits(tensors, origin, ray)
        depths.append(depth)
        indices.append(index)
        color, normal = shade_hits(tensors, origin, ray, depth, index, intrinsics.fx)
        colors.append(color)
        normals.append(normal)
    size = (len(poses), intrinsics.height, intrinsics.width)
    depth = torch.cat(depths).reshape(size).double().cpu().numpy()
    index = torch.cat(indices).reshape(size).int().cpu().numpy()
    linear = torch.cat(colors).reshape(*size, 3).float().cpu().numpy()
    if scene.daylight is not None:
        normal, ray = (x.reshape(*size, 3).double().cpu().numpy() for x in (torch.cat(normals), rays))
        seen = zip(linear, normal, depth, ray, poses[:, :3, 3], strict=True)
        linear = np.stack([lit_by_day(scene.daylight, *view) for view in seen])
    return [finish_view(scene, intrinsics, depth[k], index[k], linear[k], sensor) for k, sensor in enumerate(sensors)]


def _camera_rays(intrinsics: CameraIntrinsics, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and directions (V * H * W, 3) of all pixels; depth along a ray is z."""
    like = {"device": poses.device, "dtype": poses.dtype}
    v, u = torch.meshgrid(
        torch.arange(intrinsics.height, **like), torch.arange(intrinsics.width, **like), indexing="ij"
    )
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    camera = torch.stack((x, y, torch.ones_like(x)), -1).reshape(-1, 3)
    rays = torch.einsum("vij,rj->vri", poses[:, :3, :3], camera)
    origins = poses[:, None, :3, 3].expand_as(rays)
    return origins.reshape(-1, 3), rays.reshape(-1, 3)


def _to_device(scene: Scene, device: torch.device, dtype: torch.dtype) -> _Tensors:
    def move(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=device, dtype=dtype if array.dtype.kind == "f" else torch.int64)

    primitives, materials, lights = kernel_arrays(scene)
    return _Tensors(*(move(array) for array in (*primitives, *materials, *lights[:_LIGHT_ARRAYS])))


def first_hits(t: _Tensors, origins: torch.Tensor, rays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Ray parameter (R,) (inf = miss) and primitive number (R,) int64 (-1 = miss) of rays and origins (R, 3)."""
    o = torch.einsum("pji,rpj->rpi", t.rotation, origins[:, None] - t.center) / t.half  # (R, P, 3) in unit shapes
    d = torch.einsum("pji,rj->rpi", t.rotation, rays) / t.half  # (R, P, 3)
    sphere = _interval_of_quadric(o, d)
    round_side = _interval_of_quadric(o[..., :2], d[..., :2])
    cone = _interval_of_cone(o, d)
    slab_a, slab_b = (-1 - o) / d, (1 - o) / d
    enter, leave = torch.minimum(slab_a, slab_b), torch.maximum(slab_a, slab_b)  # (R, P, 3)
    kinds = {
        Shape.BOX: (enter.amax(-1), leave.amin(-1)),
        Shape.CYLINDER: (torch.maximum(round_side[0], enter[..., 2]), torch.minimum(round_side[1], leave[..., 2])),
        Shape.ELLIPSOID: sphere,
        Shape.FRUSTUM: (torch.maximum(cone[0], enter[..., 2]), torch.minimum(cone[1], leave[..., 2])),
        Shape.PILLOW: _interval_of_pillow(o, d, enter.amax(-1), leave.amin(-1)),
        Shape.TORUS: _interval_of_torus(o, d, enter.amax(-1), leave.amin(-1)),
        Shape.PRISM: _interval_of_prism(o, d, enter.amax(-1), leave.amin(-1)),
    }
    near, far = kinds[Shape.BOX]
    for shape, (first, last) in kinds.items():
        mine = t.shape == int(shape)
        near, far = torch.where(mine, first, near), torch.where(mine, last, far)
    near = torch.where((near <= far) & (near > NEAR_M), near, torch.inf)
    depth, index = near.min(-1)
    return depth, torch.where(torch.isfinite(depth), index, -1)


def _interval_of_quadric(o: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays are inside the unit circle or sphere; (inf, -inf) where never."""
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
    under = b * b - a * c
    root = under.clamp_min(0).sqrt()
    return torch.where(under < 0, torch.inf, (-b - root) / a), torch.where(under < 0, -torch.inf, (-b + root) / a)


def _interval_of_pillow(
    o: torch.Tensor, d: torch.Tensor, near: torch.Tensor, far: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays enter x^4 + y^4 + z^4 < 1, and ``far``; ``near`` and ``far`` are those of the box round it."""
    t = near.clamp_min(0)
    inside = ((o + t[..., None] * d) ** 4).sum(-1) - 1 < -_PILLOW_ERROR
    away = torch.zeros_like(inside)
    for _ in range(_PILLOW_STEPS):
        x = o + t[..., None] * d
        f, slope = (x**4).sum(-1) - 1, (4 * x**3 * d).sum(-1)
        away = away | ~(slope < 0)
        t = torch.where(away, t, t - f.clamp_min(0) / slope)
    hit = (f.abs() <= _PILLOW_ERROR) & ~inside & (near.clamp_min(0) <= far)
    return torch.where(hit, t, torch.inf), torch.where(hit, torch.inf, -torch.inf)


def _interval_of_torus(
    o: torch.Tensor, d: torch.Tensor, near: torch.Tensor, far: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays enter the torus, and ``far``; ``near`` and ``far`` are those of the box round it."""
    tube = 1 - _TORUS_RING
    scale = torch.tensor([1.0, 1.0, tube], dtype=o.dtype, device=o.device)
    o, d = o * scale, d * scale
    speed, t = d.norm(dim=-1), near.clamp_min(0)
    done, miss = ~(t <= far), ~(t <= far)
    tracing, away = ~done, torch.full_like(t, torch.inf)
    for k in range(_TORUS_STEPS + _TORUS_POLISH):
        x = o + t[..., None] * d
        radial = x[..., :2].norm(dim=-1)
        out = radial - _TORUS_RING
        length = torch.hypot(out, x[..., 2])
        away = torch.where(done, away, length - tube)
        if k == 0:
            inside = away < -_TORUS_ERROR
            miss, done = miss | inside, done | inside
        tracing = tracing & (away > _TORUS_CLOSE) if k < _TORUS_STEPS else torch.zeros_like(tracing)
        slope = (out / radial * (x[..., :2] * d[..., :2]).sum(-1) + x[..., 2] * d[..., 2]) / length
        done = done | (~tracing & ~(slope < 0))
        t = torch.where(done, t, t + torch.where(tracing, away / speed, -away / slope))
        past = tracing & ~done & (t > far)
        miss, done = miss | past, done | past
    hit = ~miss & (away.abs() <= _TORUS_ERROR)
    return torch.where(hit, t, torch.inf), torch.where(hit, torch.inf, -torch.inf)


def _interval_of_prism(
    o: torch.Tensor, d: torch.Tensor, near: torch.Tensor, far: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays are in x + y <= 0 and in the box round it, where they are from ``near`` to ``far``."""
    above, climb = o[..., 0] + o[..., 1], d[..., 0] + d[..., 1]
    t = -above / climb
    near = torch.where(climb < 0, torch.maximum(near, t), near)
    far = torch.where(climb > 0, torch.minimum(far, t), far)
    return torch.where((climb == 0) & (above > 0), torch.inf, near), far


def _interval_of_cone(o: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays are inside the lower half of the cone of radius 0.8 - 0.2 z; see ``hit_frustum`` of fast_cast.h."""
    radius, slope = 0.8 - 0.2 * o[..., 2], -0.2 * d[..., 2]
    a = (d[..., :2] ** 2).sum(-1) - slope**2
    b = (o[..., :2] * d[..., :2]).sum(-1) - radius * slope
    under = b * b - a * ((o[..., :2] ** 2).sum(-1) - radius**2)
    root = under.clamp_min(0).sqrt()
    first, last = (-b - root) / a, (-b + root) / a
    miss, between, up = (under < 0) & (a > 0), (under >= 0) & (a > 0), (under >= 0) & (a <= 0) & (slope < 0)
    near = torch.where(between | ((under >= 0) & ~up), first, -torch.inf)
    far = torch.where(between | up, last, torch.inf)
    return torch.where(miss, torch.inf, near), torch.where(miss, -torch.inf, far)


def shade_hits(
    t: _Tensors, origins: torch.Tensor, rays: torch.Tensor, depth: torch.Tensor, index: torch.Tensor, fx: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear RGB (R, 3) of the hits, black where there is none, and normals (R, 3). ``fx``: focal length in pixels."""
    out, normals = torch.zeros_like(rays), torch.zeros_like(rays)
    hit = (index >= 0).nonzero()[:, 0]
    view, p = -rays[hit] * depth[hit, None], index[hit]
    world = origins[hit] - view
    way = view.norm(dim=-1)
    color, normal = _shade_points(t, p, world, view, way / fx)
    mirror = t.mirror[t.material[p]]
    shows = (mirror > 0).nonzero()[:, 0]
    if len(shows):
        seen = _reflected(t, world[shows], view[shows], normal[shows], way[shows], fx)
        fraction = mirror[shows, None]
        color[shows] = (1 - fraction) * color[shows] + fraction * seen
    out[hit], normals[hit] = color, normal
    return out, normals


def _reflected(
    t: _Tensors, world: torch.Tensor, view: torch.Tensor, normal: torch.Tensor, way: torch.Tensor, fx: float
) -> torch.Tensor:
    """Light (N, 3) that mirrors at ``world`` (N, 3), ``way`` (N,) from the camera, send along ``view``."""
    toward = torch.nn.functional.normalize(view, dim=-1)
    rays = 2 * (normal * toward).sum(-1, keepdim=True) * normal - toward
    depth, index = first_hits(t, world, rays)
    out = torch.zeros_like(rays)
    hit = (index >= 0).nonzero()[:, 0]
    step = rays[hit] * depth[hit, None]
    pixel = (way + depth)[hit] / fx
    out[hit] = _shade_points(t, index[hit], world[hit] + step, -step, pixel)[0]
    return out


def _shade_points(
    t: _Tensors, p: torch.Tensor, world: torch.Tensor, view: torch.Tensor, pixel: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear RGB (N, 3) and normals (N, 3) of the points ``world`` (N, 3) of primitives p (N,), seen along -view;
    ``pixel`` (N,) is the width of a pixel there, metres."""
    rotation, half = t.rotation[p], t.half[p]
    local = torch.einsum("rji,rj->ri", rotation, world - t.center[p])
    own, axis = _own_normal(t.shape[p], local, half)
    normal = torch.einsum("rij,rj->ri", rotation, own)
    m = t.material[p]
    facing = (normal * torch.nn.functional.normalize(view, dim=-1)).sum(-1)
    footprint = pixel / facing.clamp_min(0.1).sqrt()
    base = albedo(t.pattern[m], t.color_a[m], t.color_b[m], t.scale_m[m], t.seed[m], local, half, axis, footprint)
    light = t.ambient * (0.75 + 0.25 * normal[:, 2:]) * _openness(t, world, normal)[:, None]
    for k in range(len(t.light_position)):
        light = light + _light(t, k, world, normal, view, t.gloss[m])
    return base * (light + t.emission[m, None]), normal


def _openness(t: _Tensors, world: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Fraction of the ambient light that reaches points (N, 3); see ``openness`` of fast_shade.c."""
    low, high = world / CORNER_REACH_M, (t.room - world) / CORNER_REACH_M
    fraction = (1 - CORNER_DIM / (1 + low**2)) * (1 - CORNER_DIM / (1 + high**2))
    return torch.where((normal.abs() < 0.7) & torch.isfinite(t.room), fraction, 1.0).prod(-1)


def _own_normal(shape: torch.Tensor, local: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals (N, 3) in the primitives' own axes and their dominant axis (N,)."""
    q = local / half
    side = torch.where(local > 0, 1.0, -1.0).to(local.dtype)
    box_axis = q.abs().argmax(-1)
    box = torch.nn.functional.one_hot(box_axis, 3) * side
    radial, radius = q[:, :2].norm(dim=-1), 0.8 - 0.2 * q[:, 2]
    gradient = q.clone()
    gradient[:, 2] = torch.where(shape == int(Shape.ELLIPSOID), q[:, 2], 0.0)
    gradient[:, 2] = torch.where(shape == int(Shape.FRUSTUM), 0.2 * radius, gradient[:, 2])
    gradient = torch.where((shape == int(Shape.PILLOW))[:, None], q**3, gradient)
    squeezed = (radial - _TORUS_RING) / (radial * (1 - _TORUS_RING) ** 2)
    ring = torch.stack((q[:, 0] * squeezed, q[:, 1] * squeezed, q[:, 2]), -1)
    gradient = torch.where((shape == int(Shape.TORUS))[:, None], ring, gradient)
    curved = torch.nn.functional.normalize(gradient / half, dim=-1)
    lid = (shape == int(Shape.CYLINDER)) & (q[:, 2].abs() >= radial)
    lid |= (shape == int(Shape.FRUSTUM)) & (1 - q[:, 2].abs() < (radial - radius).abs())
    top = torch.zeros_like(q)
    top[:, 2] = side[:, 2]
    own = torch.where((shape == int(Shape.BOX))[:, None], box.to(q.dtype), torch.where(lid[:, None], top, curved))
    faces = torch.stack(((q[:, 0] + q[:, 1]).abs() * 0.5**0.5, 1 + q[:, 0], 1 + q[:, 1], 1 - q[:, 2].abs()), -1)
    slant = torch.stack((1 / half[:, 0], 1 / half[:, 1], torch.zeros_like(half[:, 0])), -1)
    x, y = torch.eye(3, dtype=q.dtype, device=q.device)[:2]
    normals = torch.stack((torch.nn.functional.normalize(slant, dim=-1), -x.expand_as(q), -y.expand_as(q), top), 1)
    prism = normals[torch.arange(len(q)), faces.abs().argmin(-1)]
    own = torch.where((shape == int(Shape.PRISM))[:, None], prism, own)
    return own, own.abs().argmax(-1)


def _light(
    t: _Tensors, k: int, world: torch.Tensor, normal: torch.Tensor, view: torch.Tensor, gloss: torch.Tensor
) -> torch.Tensor:
    """What light ``k`` adds, (N, 3): Lambert and a highlight, with a shadow cube."""
    to_light = t.light_position[k] - world
    square = (to_light * to_light).sum(-1)
    toward = to_light / square.sqrt()[:, None]
    cosine = (normal * toward).sum(-1)
    middle = torch.nn.functional.normalize(toward + torch.nn.functional.normalize(view, dim=-1), dim=-1)
    shine = (normal * middle).sum(-1) ** 16
    strength = _visible(t.shadow[k], t.softness[k], -to_light) * (cosine + gloss * shine) / (square + LIGHT_RADIUS_SQ)
    return torch.where(cosine > 0, strength, 0.0)[:, None] * t.light_color[k]


def _visible(cube: torch.Tensor, softness: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    """Fraction of the light (N,) that reaches points at ``d`` (N, 3) from it; see ``scene.Lights.shadow``."""
    axis = d.abs().argmax(-1)
    pick = torch.arange(len(d), device=d.device)
    major = d[pick, axis]
    face = 2 * axis + (major <= 0).long()
    major = major.abs()
    n = cube.shape[-1]
    u = (d[pick, (axis + 1) % 3] / major + 1) * 0.5 * n - 0.5
    v = (d[pick, (axis + 2) % 3] / major + 1) * 0.5 * n - 0.5
    z = major - SHADOW_BIAS_M * (1 + 0.5 * major)
    lit = torch.zeros_like(z)
    for x, y in ((x, y) for y in (v - softness, v + softness) for x in (u - softness, u + softness)):
        x0, y0 = x.floor(), y.floor()
        wx, wy = x - x0, y - y0
        spots = ((0, 0, (1 - wx) * (1 - wy)), (1, 0, wx * (1 - wy)), (0, 1, (1 - wx) * wy), (1, 1, wx * wy))
        for dx, dy, weight in spots:
            column, row = (x0 + dx).long().clamp(0, n - 1), (y0 + dy).long().clamp(0, n - 1)
            lit = lit + torch.where(cube[face, row, column] >= z, weight, 0.0)
    return 0.25 * lit
