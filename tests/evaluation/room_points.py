"""A box room of points with a floor, a ceiling, four walls and a table, for the tests of pictures."""

from dataclasses import dataclass

import numpy as np

from semantic_mapper.labels import ROOMS

WIDTH, DEPTH, HEIGHT, TABLE = 4.0, 3.0, 2.5, 0.75


@dataclass(frozen=True)
class Points:
    xyz: np.ndarray
    rgb: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    measured: np.ndarray | None = None


def room_points(pitch: float = 0.04) -> Points:
    """Points of the room in a world with z up and the floor at 0; labels of ROOMS, everything certain."""
    parts = [
        ("floor", plane((0, WIDTH), (0, DEPTH), pitch, lambda a, b: (a, b, 0 * a))),
        ("ceiling", plane((0, WIDTH), (0, DEPTH), pitch, lambda a, b: (a, b, 0 * a + HEIGHT))),
        ("wall", plane((0, WIDTH), (0, HEIGHT), pitch, lambda a, b: (a, 0 * a, b))),
        ("wall", plane((0, WIDTH), (0, HEIGHT), pitch, lambda a, b: (a, 0 * a + DEPTH, b))),
        ("wall", plane((0, DEPTH), (0, HEIGHT), pitch, lambda a, b: (0 * a, a, b))),
        ("wall", plane((0, DEPTH), (0, HEIGHT), pitch, lambda a, b: (0 * a + WIDTH, a, b))),
        ("table", plane((1, 2.4), (1, 1.8), pitch, lambda a, b: (a, b, 0 * a + TABLE))),
    ]
    xyz = np.concatenate([p for _, p in parts]).astype(np.float32)
    label = np.concatenate([np.full(len(p), class_id(name), np.uint8) for name, p in parts])
    return Points(xyz, np.full((len(xyz), 3), 128, np.uint8), label, np.ones(len(xyz), np.float32))


def class_id(name: str) -> int:
    """Id of a class of ROOMS."""
    return ROOMS.ids[ROOMS.names.index(name)]


def plane(a_range, b_range, pitch, place) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Grid of points on a plane."""
    a, b = np.meshgrid(np.arange(*a_range, pitch), np.arange(*b_range, pitch))
    return np.stack(place(a.ravel(), b.ravel()), axis=1)
