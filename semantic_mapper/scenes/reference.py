"""The plain torch renderer: every ray against every primitive, any device. ``render.render_view`` is the fast one.

Runs in float64 on the CPU (as the compiled path does) and in float32 elsewhere unless told otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from semantic_mapper.geometry import check_pose
from semantic_mapper.scenes.config import NoiseConfig
from semantic_mapper.scenes.fast_cast import NEAR_M
from semantic_mapper.scenes.fast_shade import LIGHT_RADIUS_SQ, SHADOW_BIAS_M
from semantic_mapper.scenes.primitives import Shape
from semantic_mapper.scenes.render import RenderedView, finish_view
from semantic_mapper.scenes.scene import Scene
from semantic_mapper.scenes.textures import albedo
from semantic_mapper.types import CameraIntrinsics, Float64

_RAYS_A_CHUNK = 8192


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
    light_position: torch.Tensor
    light_color: torch.Tensor
    shadow: torch.Tensor
    ambient: torch.Tensor


def render_view_torch(
    scene: Scene,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    *,
    noise: int | None = None,
    noise_config: NoiseConfig = NoiseConfig(),
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
) -> RenderedView:
    """As ``render.render_view``, in torch operations on ``device``.

    Raises:
        PoseError: where ``T_world_camera`` is not a rigid transform.
    """
    check_pose(T_world_camera, "render_view_torch")
    device = torch.device(device)
    dtype = dtype or (torch.float64 if device.type == "cpu" else torch.float32)
    tensors = _to_device(scene, device, dtype)
    height, width = intrinsics.height, intrinsics.width
    v, u = torch.meshgrid(
        torch.arange(height, device=device, dtype=dtype), torch.arange(width, device=device, dtype=dtype), indexing="ij"
    )
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    camera = torch.stack((x, y, torch.ones_like(x)), -1).reshape(-1, 3)
    pose = torch.as_tensor(T_world_camera, device=device, dtype=dtype)
    depths, indices, colors = [], [], []
    for rays in (camera @ pose[:3, :3].T).split(_RAYS_A_CHUNK):
        depth, index = first_hits(tensors, pose[:3, 3], rays)
        depths.append(depth)
        indices.append(index)
        colors.append(shade_hits(tensors, pose[:3, 3], rays, depth, index))
    return finish_view(
        scene,
        torch.cat(depths).reshape(height, width).double().cpu().numpy(),
        torch.cat(indices).reshape(height, width).int().cpu().numpy(),
        torch.cat(colors).reshape(height, width, 3).float().cpu().numpy(),
        noise,
        noise_config,
    )


def _to_device(scene: Scene, device: torch.device, dtype: torch.dtype) -> _Tensors:
    def move(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=device, dtype=dtype if array.dtype.kind == "f" else torch.int64)

    prim, mat, light = scene.primitives, scene.materials, scene.lights
    return _Tensors(
        *(move(a) for a in (prim.shape, prim.center, prim.half, prim.rotation, prim.material)),
        *(move(a) for a in (mat.pattern, mat.color_a, mat.color_b, mat.scale_m, mat.seed, mat.emission, mat.gloss)),
        *(move(a) for a in (light.position, light.color, light.shadow, light.ambient)),
    )


def first_hits(t: _Tensors, origin: torch.Tensor, rays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Ray parameter (R,) (inf = miss) and primitive number (R,) int64 (-1 = miss) of rays (R, 3) from origin (3,)."""
    o = torch.einsum("pji,pj->pi", t.rotation, origin - t.center) / t.half  # (P, 3) in unit shapes
    d = torch.einsum("pji,rj->rpi", t.rotation, rays) / t.half  # (R, P, 3)
    sphere = _interval_of_quadric(o.expand_as(d), d)
    round_side = _interval_of_quadric(o[:, :2].expand_as(d[..., :2]), d[..., :2])
    slab_a, slab_b = (-1 - o) / d, (1 - o) / d
    enter, leave = torch.minimum(slab_a, slab_b), torch.maximum(slab_a, slab_b)  # (R, P, 3)
    box = enter.amax(-1), leave.amin(-1)
    can = torch.maximum(round_side[0], enter[..., 2]), torch.minimum(round_side[1], leave[..., 2])
    is_box, is_can = t.shape == int(Shape.BOX), t.shape == int(Shape.CYLINDER)
    near = torch.where(is_box, box[0], torch.where(is_can, can[0], sphere[0]))
    far = torch.where(is_box, box[1], torch.where(is_can, can[1], sphere[1]))
    near = torch.where((near <= far) & (near > NEAR_M), near, torch.inf)
    depth, index = near.min(-1)
    return depth, torch.where(torch.isfinite(depth), index, -1)


def _interval_of_quadric(o: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays are inside the unit circle or sphere; (inf, -inf) where never."""
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
    under = b * b - a * c
    root = under.clamp_min(0).sqrt()
    return torch.where(under < 0, torch.inf, (-b - root) / a), torch.where(under < 0, -torch.inf, (-b + root) / a)


def shade_hits(
    t: _Tensors, origin: torch.Tensor, rays: torch.Tensor, depth: torch.Tensor, index: torch.Tensor
) -> torch.Tensor:
    """Linear RGB (R, 3) of the hits; black where there is none."""
    out = torch.zeros_like(rays)
    hit = index >= 0
    view = -rays[hit] * depth[hit, None]
    world, p = origin - view, index[hit]
    rotation, half = t.rotation[p], t.half[p]
    local = torch.einsum("rji,rj->ri", rotation, world - t.center[p])
    own, axis = _own_normal(t.shape[p], local, half)
    normal = torch.einsum("rij,rj->ri", rotation, own)
    m = t.material[p]
    base = albedo(t.pattern[m], t.color_a[m], t.color_b[m], t.scale_m[m], t.seed[m], local, half, axis)
    light = t.ambient * (0.75 + 0.25 * normal[:, 2:])
    for k in range(len(t.light_position)):
        light = light + _light(t, k, world, normal, view, t.gloss[m])
    out[hit] = base * (light + t.emission[m, None])
    return out


def _own_normal(shape: torch.Tensor, local: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals (N, 3) in the primitives' own axes and their dominant axis (N,)."""
    q = local / half
    side = torch.where(local > 0, 1.0, -1.0).to(local.dtype)
    box_axis = q.abs().argmax(-1)
    box = torch.nn.functional.one_hot(box_axis, 3) * side
    flat = torch.ones_like(q)
    flat[:, 2] = (shape == int(Shape.ELLIPSOID)).to(q.dtype)
    curved = torch.nn.functional.normalize(q / half * flat, dim=-1)
    lid = (shape == int(Shape.CYLINDER)) & (q[:, 2].abs() >= q[:, :2].norm(dim=-1))
    top = torch.zeros_like(q)
    top[:, 2] = side[:, 2]
    own = torch.where((shape == int(Shape.BOX))[:, None], box.to(q.dtype), torch.where(lid[:, None], top, curved))
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
    strength = _visible(t.shadow[k], -to_light) * (cosine + gloss * shine) / (square + LIGHT_RADIUS_SQ)
    return torch.where(cosine > 0, strength, 0.0)[:, None] * t.light_color[k]


def _visible(cube: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    """Share of the light (N,) that reaches points at ``d`` (N, 3) from it; see ``scene.Lights.shadow``."""
    axis = d.abs().argmax(-1)
    pick = torch.arange(len(d), device=d.device)
    major = d[pick, axis]
    face = 2 * axis + (major <= 0).long()
    major = major.abs()
    n = cube.shape[-1]
    u = (d[pick, (axis + 1) % 3] / major + 1) * 0.5 * n - 0.5
    v = (d[pick, (axis + 2) % 3] / major + 1) * 0.5 * n - 0.5
    u0, v0 = u.floor(), v.floor()
    wu, wv = u - u0, v - v0
    z = major - SHADOW_BIAS_M * (1 + 0.5 * major)
    lit = torch.zeros_like(z)
    for du, dv, weight in ((0, 0, (1 - wu) * (1 - wv)), (1, 0, wu * (1 - wv)), (0, 1, (1 - wu) * wv), (1, 1, wu * wv)):
        column, row = (u0 + du).long().clamp(0, n - 1), (v0 + dv).long().clamp(0, n - 1)
        lit = lit + torch.where(cube[face, row, column] >= z, weight, 0.0)
    return lit
