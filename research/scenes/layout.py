"""Where things stand: wall slots, free spots, tops of furniture; nothing overlaps and doors stay clear."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture import FURNITURE
from research.scenes.furniture.varied import VARIANTS
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Part, Top, part_bounds, place_parts, rotation_z, scaled
from research.scenes.shell import Shell, build_shell, wall_pose
from semantic_mapper.types import Float64

_GAP_M = 0.015  # between two pieces, and between a piece and the wall behind it
_WALLS = 4
_SIZES = (0.8, 1.2)  # of the pieces of varied rooms, in terms of those of others
_THINGS_M2 = 14.0  # small things a square metre of table or counter


class Layout:
    """A room being furnished. Pieces that find no place are left out.

    Args:
        size_m: Width, depth, height.
        rng: Draws everything.
        palette: The room's materials.
        wet: A bathroom, with tiles.
        variety: Draws what only varied rooms have; None: not one of them.
        shell: Of the room; None: one is drawn.
    """

    def __init__(
        self,
        size_m: tuple[float, float, float],
        rng: np.random.Generator,
        palette: Palette,
        *,
        wet: bool = False,
        variety: np.random.Generator | None = None,
        shell: Shell | None = None,
    ) -> None:
        self.size_m = size_m
        self.rng = rng
        self.palette = palette
        self.variety = variety
        self._sizes: dict[str, float] = {}  # by which each kind of piece is larger, in a varied room
        self.groups: list[list[Part]] = []
        self.lamps: list[Float64] = []
        self._tops: list[tuple[Top, float, Float64]] = []  # with yaw and position of the piece they belong to
        self._low, self._high = np.zeros((0, 3)), np.zeros((0, 3))  # of all parts that stand
        self._free_low, self._free_high = np.zeros((0, 3)), np.zeros((0, 3))  # zones to keep free
        shell = shell or build_shell(size_m, rng, palette, wet=wet, variety=variety)
        self.groups.extend(shell.groups)
        self.far_lamp = shell.lamp
        self.has_opening = shell.free is not None
        if shell.free is not None:
            self._free_low, self._free_high = (corner[None] for corner in shell.free)

    def make(self, name: str, rng: np.random.Generator | None = None) -> Assembly:
        """A specimen of a piece, drawn by ``rng`` or else the room's; in a varied room, each kind has its own size."""
        if self.variety is not None and name in VARIANTS and self.variety.uniform() < 0.5:
            name = VARIANTS[name]
        piece = FURNITURE[name].make(self.rng if rng is None else rng, self.palette)
        if self.variety is None:
            return piece
        if name not in self._sizes:
            self._sizes[name] = float(np.exp(self.variety.uniform(*np.log(_SIZES))))
        return scaled(piece, self._sizes[name])

    def put(self, assembly: Assembly, yaw: float, position: Float64, *, in_keep_free: bool = False) -> bool:
        """Stand ``assembly`` at ``position`` (3,) if nothing is in the way; ``in_keep_free``: it may stand where space
        was to be left (a chair at its desk)."""
        parts = place_parts(assembly, yaw, position)
        low, high = (np.array(side) for side in zip(*(part_bounds(p) for p in parts), strict=True))
        room = np.array(self.size_m)
        if (low < -1e-6).any() or (high > room + 1e-6).any():
            return False
        if _any_overlap(low - _GAP_M, high + _GAP_M, self._low, self._high):
            return False
        if not in_keep_free and _any_overlap(low, high, self._free_low, self._free_high):
            return False
        zone = self._front_zone(assembly, yaw, position)
        if zone is not None and _any_overlap(zone[0], zone[1], self._low, self._high):
            return False
        if zone is not None:
            self._free_low, self._free_high = (
                np.vstack((self._free_low, zone[0])),
                np.vstack((self._free_high, zone[1])),
            )
        self._low, self._high = np.vstack((self._low, low)), np.vstack((self._high, high))
        self.groups.append(parts)
        turn = rotation_z(yaw)
        self.lamps.extend(turn @ np.array(lamp) + position for lamp in assembly.lamps)
        self._tops.extend((top, yaw, position) for top in assembly.tops)
        return True

    def _front_zone(self, assembly: Assembly, yaw: float, position: Float64) -> tuple[Float64, Float64] | None:
        if assembly.keep_free_m <= 0:
            return None
        low, high = assembly.bounds()
        corners = np.array(
            [
                (x, y, 0.0)
                for x in (low[0] + 0.05, high[0] - 0.05)
                for y in (high[1] + 0.02, high[1] + assembly.keep_free_m)
            ]
        )
        world = corners @ rotation_z(yaw).T + position
        world[:, :2] = np.clip(world[:, :2], 0.0, self.size_m[:2])
        zone_low, zone_high = world.min(0, keepdims=True), world.max(0, keepdims=True)
        zone_low[:, 2], zone_high[:, 2] = 0.05, 2.0
        return zone_low, zone_high

    def at_wall(
        self, assembly: Assembly, *, corner: bool, flush: bool, tries: int = 30
    ) -> tuple[float, Float64] | None:
        """Somewhere along a wall; returns the pose it got, or None. ``flush``: touching the wall."""
        low, high = assembly.bounds()
        for attempt in range(tries):
            wall = int(self.rng.integers(_WALLS))
            length = self.size_m[wall % 2]
            first, last = -low[0] + 0.03, length - high[0] - 0.03
            if last <= first:
                continue
            if corner and attempt < tries // 2:
                along = first if self.rng.uniform() < 0.5 else last
            else:
                along = self.rng.uniform(first, last)
            away = 0.0 if flush else self.rng.uniform(0.02, 0.05) - low[1]
            yaw, position = wall_pose(self.size_m, wall, float(along), float(away))
            if self.put(assembly, yaw, position):
                return yaw, position
        return None

    def in_corner(self, assembly: Assembly) -> bool:
        """With its left end in one of the room's corners, its back to the wall."""
        low, _ = assembly.bounds()
        for wall in self.rng.permutation(_WALLS):
            yaw, position = wall_pose(self.size_m, int(wall), float(0.03 - low[0]), float(0.03 - low[1]))
            if self.put(assembly, yaw, position):
                return True
        return False

    def in_centre(self, assembly: Assembly, *, tries: int = 30, margin_m: float = 0.3) -> tuple[float, Float64] | None:
        """Free in the room, along its axes; returns the pose it got, or None."""
        low, high = assembly.bounds()
        middle = np.array([*(low + high)[:2] / 2, 0.0])
        for _ in range(tries):
            yaw = int(self.rng.integers(_WALLS)) * np.pi / 2
            half = np.abs(rotation_z(yaw) @ ((high - low) / 2))[:2] + margin_m
            room = np.array(self.size_m[:2])
            if (room <= 2 * half).any():
                continue
            center = np.append(self.rng.uniform(half, room - half), 0.0)
            position = center - rotation_z(yaw) @ middle
            if self.put(assembly, yaw, position):
                return yaw, position
        return None

    def on_floor_unchecked(self, assembly: Assembly, yaw: float, position: Float64) -> None:
        """Lay something flat under whatever stands there (a rug), if it stays inside the room."""
        parts = place_parts(assembly, yaw, position)
        low, high = (np.array(side) for side in zip(*(part_bounds(p) for p in parts), strict=True))
        if (low[:, :2] >= 0.02).all() and (high[:, :2] <= np.array(self.size_m[:2]) - 0.02).all():
            self.groups.append(parts)

    def clutter(self, fraction: float, names: tuple[str, ...]) -> None:
        """Small things on the tops of furniture: ``fraction`` of about fourteen a square metre; some tops are nearly
        bare, some crowded."""
        for top, yaw, position in list(self._tops):
            area = max(top.x1 - top.x0, 0.0) * max(top.y1 - top.y0, 0.0)
            crowd = fraction * float(self.rng.choice((0.2, 0.8, 1.3, 2.0)))
            for _ in range(int(self.rng.poisson(crowd * (area * _THINGS_M2 + 0.3)))):
                small = self.make(names[int(self.rng.integers(len(names)))])
                low, high = small.bounds()
                x0, x1 = top.x0 - low[0] + 0.02, top.x1 - high[0] - 0.02
                y0, y1 = top.y0 - low[1] + 0.02, top.y1 - high[1] - 0.02
                if x0 < x1 and y0 < y1:
                    own = np.array([self.rng.uniform(x0, x1), self.rng.uniform(y0, y1), top.z + _GAP_M + 1e-4])
                    self._set_down(small, yaw, position + rotation_z(yaw) @ own)

    def _set_down(self, small: Assembly, yaw: float, position: Float64) -> None:
        # The overlap test keeps a gap all round: it is made a gap above the top, then the piece is let down onto it.
        if self.put(small, yaw, position, in_keep_free=True):
            drop = np.array([0.0, 0.0, _GAP_M])
            self.groups[-1] = place_parts(small, yaw, position - drop)


def _any_overlap(low: Float64, high: Float64, other_low: Float64, other_high: Float64) -> bool:
    """Whether any box of (N, 3) corners overlaps any of (M, 3)."""
    if not len(other_low):
        return False
    apart = (low[:, None] >= other_high[None]) | (high[:, None] <= other_low[None])
    return bool((~apart.any(-1)).any())
