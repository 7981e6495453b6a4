"""What a voxel map gives out: plain data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_grid import BLOCK_SIDE
from semantic_mapper.types import Float32, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """N points of the fused surface.

    Args:
        xyz: (N, 3) float32 metres in the world.
        rgb: (N, 3) uint8.
        label: (N,) uint8 class ids, the label set's ignore id where nothing voted.
        confidence: (N,) float32 probability of ``label``, 0 where nothing voted.
    """

    xyz: Float32
    rgb: UInt8
    label: UInt8
    confidence: Float32


@dataclass(frozen=True, slots=True, eq=False)
class MapMesh:
    """The fused surface as V vertices and F triangles.

    Args:
        vertices: (V, 3) float32 metres in the world.
        faces: (F, 3) int32 vertex indices.
        rgb: (V, 3) uint8.
        label: (V,) uint8 class ids, the ignore id where nothing voted.
        confidence: (V,) float32, 0 where nothing voted.
    """

    vertices: Float32
    faces: NDArray[np.int32]
    rgb: UInt8
    label: UInt8
    confidence: Float32


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """The map seen from a pose.

    Args:
        depth_m: (H, W) float32 z-depth, 0 where the ray meets no surface.
        rgb: (H, W, 3) uint8.
        label: (H, W) uint8 class ids, the ignore id at misses and where nothing voted.
        confidence: (H, W) float32, 0 where ``label`` is the ignore id.
    """

    depth_m: Float32
    rgb: UInt8
    label: UInt8
    confidence: Float32


@dataclass(frozen=True, slots=True, eq=False)
class MapState:
    """Everything a map is made of, blocks in lexicographic order of their keys; voxels in the order [z][y][x].

    Args:
        config: Of the map.
        label_set: Of the map.
        frames: Frames fused so far.
        last_stamp_ns: Stamp of the last of them, 0 before the first.
        keys: (B, 3) int32 block coordinates.
        tsdf, weight, votes: (B, 512) float32.
        color: (B, 512, 3) float32.
        evidence: (B, 512, L) float32.
    """

    config: VoxelMapConfig
    label_set: LabelSet
    frames: int
    last_stamp_ns: int
    keys: NDArray[np.int32]
    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: Float32
    votes: Float32

    def cubes(self) -> dict[str, NDArray[np.generic]]:
        """By name: ``keys``, and the others with voxels as cubes (B, 8, 8, 8, ...)."""
        cube = (len(self.keys), BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
        return {
            "keys": self.keys,
            "tsdf": self.tsdf.reshape(cube),
            "weight": self.weight.reshape(cube),
            "color": self.color.reshape(*cube, 3),
            "evidence": self.evidence.reshape(*cube, len(self.label_set)),
            "votes": self.votes.reshape(cube),
        }
