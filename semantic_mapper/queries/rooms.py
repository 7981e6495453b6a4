"""Rooms of one floor: its plan, parted where it is as narrow as a door.

Every cell of the plan climbs to the place near by that is farthest from the walls; cells that end at one place are its
basin. Two basins are one room where the passage between them is wider than a door, or nearly as wide as the smaller."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy  # loads `ndimage` when it is first used
from numpy.typing import NDArray

from semantic_mapper.types import Bool, Float64, Int64, UInt8

DOOR_M = 1.05  # wider passages part no rooms
LEAST_DOOR_M = 0.5  # narrower passages are holes in what was seen of a wall
SAME_WIDTH = 0.77  # of the smaller basin's greatest clearance: a passage so wide parts no rooms
LEAST_ROOM_M2 = 1.0  # what is smaller belongs to the room that it opens to, or to none
WALL_CLOSING_M = 0.15  # holes of a wall up to twice this are closed, and so is its inside
LEAST_WALL_M = 0.5  # a wall that is shorter (a column, a lamp) parts no rooms
MOST_UNSEEN_M = 0.6  # width of a gap in what was seen of one room: no wall is known to be in it
MOST_HIDDEN_M2 = 1.5  # of floor that is hidden, behind or under furniture


class Passage(NamedTuple):
    """Where two rooms meet: their numbers, the cell (row, column) in the middle of it, and its width in metres."""

    rooms: tuple[int, int]
    cell: tuple[int, int]
    width_m: float


class RoomPlan(NamedTuple):
    """Rooms of a plan."""

    room: Int64  # (H, W) int64 number of the room, from 0; -1 = none
    rooms: int  # how many there are
    clearance_m: Float64  # (H, W) float64 distance to the nearest cell outside, 0 outside
    passages: tuple[Passage, ...]  # between rooms


def find_walls(shown: Bool, cell_m: float) -> Bool:
    """Cells (H, W) of walls, of those where one was seen: holes and their inside are closed, short pieces left out."""
    reach = round(WALL_CLOSING_M / cell_m)
    closed = _closed(shown, reach, np.ones((2 * reach + 1,) * 2, np.uint8))
    _, parts, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    long = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) * cell_m >= LEAST_WALL_M
    long[0] = False
    return long[parts.astype(np.int64)]


def _closed(mask: Bool, reach: int, kernel: NDArray[Any]) -> UInt8:
    """A mask (H, W) without holes of up to twice the reach."""
    padded = np.pad(mask, 2 * reach).astype(np.uint8)
    inside = tuple(slice(2 * reach, 2 * reach + side) for side in mask.shape)
    return np.ascontiguousarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[inside], np.uint8)


def part_rooms(seen: Bool, wall: Bool, cell_m: float) -> RoomPlan:
    """Part a plan into rooms, by where floor or furniture was seen, and where there is a wall (H, W)."""
    reach = round(MOST_UNSEEN_M / 2 / cell_m)
    inside = (_closed(seen, reach, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)) > 0) & ~wall
    inside[[0, -1]] = inside[:, [0, -1]] = False
    inside |= _small_parts(~inside & ~wall, MOST_HIDDEN_M2 / cell_m**2)
    clearance = np.asarray(scipy.ndimage.distance_transform_edt(inside, sampling=cell_m), np.float64)
    basin, peak = _basins(inside, clearance)
    first, second, saddle = _contacts(basin, clearance)
    group = _merge(first, second, saddle, peak)
    size = np.bincount(group[basin[inside]], minlength=len(peak)) * cell_m**2
    for a, b in zip(first, second, strict=True):  # by descending width
        one, other = group[a], group[b]
        if one != other and min(size[one], size[other]) < LEAST_ROOM_M2:
            small, large = sorted((one, other), key=lambda g: size[g])
            group[group == small], size[large] = large, size[large] + size[small]
    kept = np.flatnonzero((np.arange(len(peak)) == group) & (size >= LEAST_ROOM_M2))
    number = np.full(len(peak) + 1, -1)
    number[kept] = np.arange(len(kept))
    number[:-1] = number[group]
    room = number[basin]
    return RoomPlan(room, len(kept), clearance, _passages(room, clearance))


def _small_parts(mask: Bool, most_cells: float) -> Bool:
    """Connected parts (H, W) of a mask that have so many cells at most, and do not touch the plan's edge."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= most_cells
    small[0] = False
    part = parts.astype(np.int64)
    small[np.concatenate((part[0], part[-1], part[:, 0], part[:, -1]))] = False
    return small[part]


def _basins(inside: Bool, clearance: Float64) -> tuple[Int64, Float64]:
    """Number of the basin (H, W) of each cell, -1 outside, and the clearance (B,) of the highest cell of each."""
    rank = np.zeros(inside.size, np.int64)
    rank[np.argsort(clearance, axis=None, kind="stable")] = np.arange(inside.size)
    rank = np.where(inside, rank.reshape(inside.shape), -1)
    best = np.arange(inside.size).reshape(inside.shape)
    highest = rank.copy()
    for a, b in _NEIGHBOURS:
        for here, there in ((a, b), (b, a)):
            better = rank[there] > highest[here]
            highest[here] = np.where(better, rank[there], highest[here])
            best[here] = np.where(better, np.arange(inside.size).reshape(inside.shape)[there], best[here])
    up = best.ravel()
    while (up[up] != up).any():
        up = up[up]
    tops, number = np.unique(up[inside.ravel()], return_inverse=True)
    basin = np.full(inside.shape, -1)
    basin[inside] = number
    return basin, clearance.ravel()[tops]


_ALL, _BUT_LAST, _BUT_FIRST = slice(None), slice(None, -1), slice(1, None)
_NEIGHBOURS = (((_ALL, _BUT_LAST), (_ALL, _BUT_FIRST)), ((_BUT_LAST, _ALL), (_BUT_FIRST, _ALL)))


def _contacts(number: Int64, clearance: Float64) -> tuple[Int64, Int64, Float64]:
    """Pairs (P,) of numbers >= 0 that meet, the smaller first, and the greatest clearance there; the widest first."""
    one, other, value = [], [], []
    for a, b in _NEIGHBOURS:
        meet = (number[a] != number[b]) & (number[a] >= 0) & (number[b] >= 0)
        one.append(np.minimum(number[a], number[b])[meet])
        other.append(np.maximum(number[a], number[b])[meet])
        value.append(np.minimum(clearance[a], clearance[b])[meet])
    first, second, saddle = map(np.concatenate, (one, other, value))
    order = np.argsort(-saddle, kind="stable")
    _, once = np.unique(first[order] * (number.max() + 1) + second[order], return_index=True)
    rows = order[np.sort(once)]
    return first[rows], second[rows], saddle[rows]


def _merge(first: Int64, second: Int64, saddle: Float64, peak: Float64) -> Int64:
    """Which basin (B,) stands for each one's room."""
    group, highest = np.arange(len(peak)), peak.copy()

    def root(k: int) -> int:
        while group[k] != k:
            group[k] = k = int(group[group[k]])
        return k

    for a, b, height in zip(first.tolist(), second.tolist(), saddle.tolist(), strict=True):
        one, other = root(a), root(b)
        wide = 2 * height >= DOOR_M or height >= SAME_WIDTH * min(highest[one], highest[other])
        if one != other and wide:
            low, high = sorted((one, other), key=lambda g: highest[g])
            group[low] = high
    return np.array([root(k) for k in range(len(peak))], np.int64)


def _passages(room: Int64, clearance: Float64) -> tuple[Passage, ...]:
    """Every place where two rooms meet; two rooms may have several doors between them."""
    found: list[Passage] = []
    first, second, saddle = _contacts(room, clearance)
    for a, b in zip(first[2 * saddle >= LEAST_DOOR_M].tolist(), second.tolist(), strict=False):
        touching = np.zeros(room.shape, np.bool_)  # cells of room a that have one of room b next to them
        for here, there in _NEIGHBOURS:
            touching[here] |= (room[here] == a) & (room[there] == b)
            touching[there] |= (room[there] == a) & (room[here] == b)
        count, parts = cv2.connectedComponents(touching.astype(np.uint8), connectivity=8)
        for part in range(1, count):
            row, column = np.unravel_index(int(np.where(parts == part, clearance, -1).argmax()), room.shape)
            width = 2 * float(clearance[row, column])
            if width >= LEAST_DOOR_M:
                found.append(Passage((a, b), (int(row), int(column)), width))
    return tuple(found)
