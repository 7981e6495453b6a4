"""The plan of a town: where streets, blocks, river and bridges lie."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from research.scenes.aerial.builder import ROAD_M

RIVER_ROW_M = 84.0  # depth of the row that the river takes, with both its streets' halves
RIVER_M = 11.0  # half the width of the water
DECK_M = 5.0  # height of a bridge above the streets


@dataclass(frozen=True, slots=True)
class Rectangle:
    """[x0, x1] x [y0, y1] in metres."""

    x0: float
    x1: float
    y0: float
    y1: float

    @property
    def middle(self) -> tuple[float, float]:
        """Its centre."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def size(self) -> tuple[float, float]:
        """Along x and y."""
        return self.x1 - self.x0, self.y1 - self.y0

    def shrunk(self, by: float) -> Rectangle:
        """Without a border of this width."""
        return Rectangle(self.x0 + by, self.x1 - by, self.y0 + by, self.y1 - by)


@dataclass(frozen=True, slots=True)
class TownPlan:
    """Streets run along all edges, but only bridges cross the row of the river.

    Args:
        xs: Middle lines of the streets along y, ascending.
        ys: Of those along x.
        river: Number of the row that the river takes.
        bridges: Numbers of the streets along y that cross it.
    """

    xs: tuple[float, ...]
    ys: tuple[float, ...]
    river: int
    bridges: tuple[int, ...]

    @property
    def reach_m(self) -> float:
        """Half the longer side of the town."""
        return max(self.xs[-1], self.ys[-1])

    @property
    def river_y(self) -> float:
        """Middle of the river."""
        return (self.ys[self.river] + self.ys[self.river + 1]) / 2

    def block_rows(self) -> list[int]:
        """Rows with blocks."""
        return [row for row in range(len(self.ys) - 1) if row != self.river]

    def block(self, column: int, row: int) -> Rectangle:
        """A block between its streets, sidewalks included."""
        x0, x1, y0, y1 = self.xs[column], self.xs[column + 1], self.ys[row], self.ys[row + 1]
        return Rectangle(x0 + ROAD_M, x1 - ROAD_M, y0 + ROAD_M, y1 - ROAD_M)

    def quays(self) -> list[Rectangle]:
        """What lies between the river and its streets, from bridge to bridge."""
        edges = [self.xs[0], *(self.xs[k] for k in self.bridges), self.xs[-1]]
        south = self.ys[self.river] + ROAD_M, self.river_y - RIVER_M - 1.0
        north = self.river_y + RIVER_M + 1.0, self.ys[self.river + 1] - ROAD_M
        aside = ROAD_M + 3.5  # of a bridge's middle line
        pairs = list(itertools.pairwise(edges))
        return [Rectangle(x0 + aside, x1 - aside, *bank) for x0, x1 in pairs for bank in (south, north)]
