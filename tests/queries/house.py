"""Maps of houses made of boxes, as a mapper would have them, without a camera: exact distances to the nearest box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.blocks import pack_keys
from semantic_mapper.mapping.changes import UNOBSERVED, BlockChanges
from semantic_mapper.types import Float64

LABELS = make_label_set("house", ("floor", "wall", "ceiling", "table", "door"))
VOXEL_M, TRUNCATION = 0.05, 4.0
SEEN_M = 0.12  # of solid matter behind its surface
AIR = "air"  # where the camera was: only what borders on it was seen
Box = tuple[str, tuple[float, float, float], tuple[float, float, float]]  # class or ``AIR``, lower and upper corner
STOREY_M = 2.8
UPRIGHT = np.eye(3)


def two_rooms(z: float = 0.0, *, door_m: float = 0.8, east: bool = True) -> list[Box]:
    """Two rooms of 3 x 3 m side by side, west from x = 0, east from x = 3.1; a table stands in the east one.

    Args:
        z: Height of the floor.
        door_m: Width of the door in the wall between them.
        east: Whether that room was seen.
    """
    top, half = z + 2.45, door_m / 2
    end = 6.1 if east else 3.1
    boxes: list[Box] = [
        (AIR, (0.0, 0.0, z), (3.0, 3.0, top)),
        (AIR, (3.0, 1.5 - half, z), (3.1, 1.5 + half, z + 2.0)),
        ("floor", (0.0, 0.0, z - 0.15), (end, 3.0, z)),
        ("ceiling", (0.0, 0.0, top), (end, 3.0, top + 0.15)),
        ("wall", (-0.15, 0.0, z), (0.0, 3.0, top)),
        ("wall", (0.0, -0.15, z), (end, 0.0, top)),
        ("wall", (0.0, 3.0, z), (end, 3.15, top)),
        ("wall", (3.0, 0.0, z), (3.1, 1.5 - half, top)),
        ("wall", (3.0, 1.5 + half, z), (3.1, 3.0, top)),
        ("wall", (3.0, 1.5 - half, z + 2.0), (3.1, 1.5 + half, top)),
    ]
    if east:
        boxes += [(AIR, (3.1, 0.0, z), (6.1, 3.0, top)), ("wall", (6.1, 0.0, z), (6.25, 3.0, top))]
        boxes += [("table", (4.6, 0.6, z), (5.4, 1.2, z + 0.7))]
    return boxes


def house_changes(boxes: Sequence[Box], since: int, R_world_house: Float64 = UPRIGHT) -> BlockChanges:
    """What a mirror needs to know of a house, in a world that is turned by whole quarter turns."""
    turned = [(name, *np.sort((R_world_house @ np.array((low, high)).T).T, axis=0)) for name, low, high in boxes]
    first = np.floor(np.min([low for _, low, _ in turned], axis=0) / VOXEL_M / 8).astype(int) - 1
    last = np.floor(np.max([high for _, _, high in turned], axis=0) / VOXEL_M / 8).astype(int) + 1
    axes = [np.arange(a * 8, (b + 1) * 8) * VOXEL_M for a, b in zip(first, last, strict=True)]
    distance = np.full([len(axis) for axis in axes], np.inf, np.float32)
    label, seen = np.zeros(distance.shape, np.uint8), np.zeros(distance.shape, np.bool_)
    for name, low, high in turned:
        x, y, z = (np.maximum(a - axis, axis - b) for axis, a, b in zip(axes, low, high, strict=True))
        q = np.stack(np.broadcast_arrays(x[:, None, None], y[None, :, None], z[None, None])).astype(np.float32)
        own = np.sqrt((np.maximum(q, 0) ** 2).sum(axis=0)) + np.minimum(q.max(axis=0), 0)
        if name == AIR:
            seen |= own <= SEEN_M
            continue
        label[own < distance] = LABELS.ids[LABELS.names.index(name)]
        distance = np.minimum(distance, own)
    steps = distance / (TRUNCATION * VOXEL_M) * 127
    tsdf = np.where((np.abs(steps) <= 127) & seen, steps, UNOBSERVED).astype(np.int8)

    def cut(values: np.ndarray) -> np.ndarray:
        blocks = values.reshape([n for size in values.shape for n in (size // 8, 8)]).transpose(0, 2, 4, 5, 3, 1)
        return np.ascontiguousarray(blocks).reshape(-1, 512)

    keys = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)), indexing="ij"), -1)
    keys, tsdf, label = keys.reshape(-1, 3).astype(np.int32), cut(tsdf), cut(label)
    kept = np.flatnonzero((tsdf != UNOBSERVED).any(axis=1))
    kept = kept[np.argsort(pack_keys(keys[kept]))]
    tsdf, label = tsdf[kept], np.where(tsdf[kept] == UNOBSERVED, 0, label[kept]).astype(np.uint8)
    confidence = np.where(label > 0, 204, 0).astype(np.uint8)
    rgb = np.zeros((len(kept), 512, 3), np.uint8)
    return BlockChanges(since, since + 1, since + 1, 0, keys[kept], tsdf, label, confidence, rgb)
