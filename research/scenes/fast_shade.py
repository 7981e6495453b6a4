"""Colour of every first hit, compiled: procedural texture, ambient light, lamps with soft shadows, mirrors.

``reference.shade_hits`` is the same in plain torch; a test holds the two together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from research.kernels import kernel
from research.scenes.fast_cast import expect_primitives
from semantic_mapper.errors import ShapeError
from semantic_mapper.geometry import expect_shape
from semantic_mapper.types import Float32, Float64, Int32, Int64


class PrimitiveArrays(NamedTuple):
    """What the shading reads of ``Primitives``."""

    shape: Int64
    center: Float64
    half: Float64
    rotation: Float64
    material: Int64


class MaterialArrays(NamedTuple):
    """What it reads of ``MaterialTable``."""

    pattern: Int64
    color_a: Float64
    color_b: Float64
    scale_m: Float64
    seed: Int64
    emission: Float64
    gloss: Float64
    mirror: Float64


class LightArrays(NamedTuple):
    """What it reads of ``Lights``, and the size (3,) of the room; inf = it has no walls."""

    position: Float64
    color: Float64
    shadow: Float32
    softness: Float64
    ambient: Float64
    room: Float64
    low: Float32
    high: Float32


def shade_pixels(
    depth: Float64,
    index: Int32,
    primitives: PrimitiveArrays,
    materials: MaterialArrays,
    lights: LightArrays,
    origin: Float64,
    camera_axes: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> Float32:
    """Linear RGB (H, W, 3) float32 of the hits that ``fast_cast.cast_pixels`` found; misses are black.

    Raises ShapeError: an array has another shape, or a primitive a material that does not exist.

    Args:
        depth, index: (H, W) of ``cast_pixels``.
        primitives, materials, lights: Of ``scene.kernel_arrays``.
        origin, camera_axes, fx, fy, cx, cy: As ``cast_pixels`` got them.
    """
    _check(depth, index, primitives, materials, lights)
    expect_shape(origin, "3", "origin")
    expect_shape(camera_axes, "3 3", "camera_axes")
    out = np.zeros((*depth.shape, 3), np.float32)
    camera = (np.ascontiguousarray(origin), np.ascontiguousarray(camera_axes), fx, fy, cx, cy)
    shade_hits(np.ascontiguousarray(depth), np.ascontiguousarray(index), *camera, primitives, materials, lights, out)
    return out


def surface_normals(
    depth: Float64,
    index: Int32,
    primitives: PrimitiveArrays,
    origin: Float64,
    camera_axes: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> Float64:
    """Unit normals (H, W, 3) float64 in world axes of the hits that ``cast_pixels`` found; zeros where it found none.

    Args: as ``shade_pixels``. Raises ShapeError: an array has another shape.
    """
    expect_shape(index, "{} {}".format(*expect_shape(depth, "H W", "depth").values()), "index")
    expect_primitives(*primitives[:4])
    out = np.zeros((*depth.shape, 3))
    camera = (np.ascontiguousarray(origin), np.ascontiguousarray(camera_axes), fx, fy, cx, cy)
    _surface_normals(np.ascontiguousarray(depth), np.ascontiguousarray(index), *camera, *primitives[:4], out)
    return out


def _check(
    depth: Float64, index: Int32, primitives: PrimitiveArrays, materials: MaterialArrays, lights: LightArrays
) -> None:
    expect_shape(index, "{} {}".format(*expect_shape(depth, "H W", "depth").values()), "index")
    expect_primitives(*primitives[:4])
    expect_shape(primitives.material, str(len(primitives.shape)), "material")
    count = expect_shape(materials.pattern, "M", "pattern")["M"]
    for name, array in zip(materials._fields, materials, strict=True):
        expect_shape(array, f"{count} 3" if name.startswith("color") else str(count), name)
    used = primitives.material
    if used.size and not 0 <= used.min() <= used.max() < count:
        raise ShapeError(f"material: expected numbers of {count} materials, got {used.min()} to {used.max()}")
    count, side = len(lights.position), max(1, lights.shadow.shape[-1])
    cubes = f"{count} 6 {side} {side}"
    patterns = (f"{count} 3", f"{count} 3", cubes, str(count), "3", "3", cubes, cubes)
    for name, pattern, array in zip(lights._fields, patterns, lights, strict=True):
        expect_shape(array, pattern, name)


@kernel
def _surface_normals(
    depth: Float64,
    index: Int32,
    origin: Float64,
    camera_axes: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    shape: Int64,
    center: Float64,
    half: Float64,
    rotation: Float64,
    out: Float64,
) -> None:
    """Write ``out`` (H, W, 3), which holds zeros."""
    ...


@kernel
def shade_hits(
    depth: Float64,
    index: Int32,
    origin: Float64,
    camera_axes: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    primitives: PrimitiveArrays,
    materials: MaterialArrays,
    lights: LightArrays,
    out: Float32,
) -> None:
    """Write ``out`` (H, W, 3), which holds zeros."""
    ...
