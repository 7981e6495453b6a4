"""What the parts of a town are made with: random numbers, materials shared by classes, and where parts are put."""

from __future__ import annotations

import numpy as np

from research.scenes.materials import Color, Material, Pattern, display_hsv
from research.scenes.primitives import Assembly, Part, rotation_x, rotation_z, turned_parts

STOREY_M = 3.0
SHARED = 0.5  # probability that two classes of a pair share one material
ROAD_M = 4.5  # half the width of a street
WALK_M = 2.5  # width of a sidewalk
KERB_M = 0.16


class TownBuilder:
    """Collects materials and parts in the frame of the world: centre of the town at the origin, z up, streets at 0.

    Few colours are shared by all classes, so that colour tells little. Flat roofs and bridges are of the streets' very
    asphalt, and edged alike; water, sidewalks and the floors of car parks have its colours; squares, walls, fronts and
    paths are of one pale stone, trees of the grass, and vehicles, signs and clothes of one set of lacquers.

    Args:
        rng: Of everything that is drawn.
        crowd: How full streets, parks and car parks are, 1 = as they can be.
    """

    def __init__(self, rng: np.random.Generator, crowd: float) -> None:
        self.rng, self.crowd = rng, crowd
        self.materials: list[Material] = []
        self.groups: list[list[Part]] = []
        plain, between = Pattern.PLAIN, self.between
        grey = (between(0.55, 0.6), between(0.08, 0.14), between(0.48, 0.54))
        self.asphalt = self.material(plain, grey, scale_m=2.5, dim=0.65)
        self.water = self.material(plain, grey, scale_m=5.0, dim=0.6)
        self.parking = self.material(plain, grey, scale_m=3.5, dim=0.55)
        self.walk = self.parking  # of sidewalks, and of the edges of bridges and flat roofs
        pale = (between(0.07, 0.11), between(0.06, 0.12), between(0.6, 0.66))
        self.paving = self.material(Pattern.TILES, pale, scale_m=1.2, dim=0.6)
        self.square = self.paving if self.often(SHARED) else self.material(plain, pale, scale_m=2.0, dim=0.6)
        self.brick = self.material(Pattern.TILES, grey, scale_m=0.5, dim=0.7)
        self.paint = self.material(plain, (pale[0], 0.06, 0.66), scale_m=0.8, dim=0.6)
        self.zebra = self.material(Pattern.STRIPES, (pale[0], 0.06, 0.7), scale_m=1.1, dim=0.3)
        green = (between(0.2, 0.27), between(0.42, 0.5), between(0.4, 0.46))
        self.grass = self.material(plain, green, scale_m=1.4, dim=0.4)
        self.leaves = [self.grass, self.material(plain, green, scale_m=0.6, dim=0.3)]
        self.crops = [self.material(Pattern.STRIPES, (h, 0.4, 0.5), scale_m=3.0) for h in (0.12, 0.25, 0.09)]
        fronts = [pale, pale, (0.58, 0.06, 0.6), (0.05, 0.3, 0.6)]
        self.walls = [self._front(front) for front in fronts]
        self.plaster = [self._front((h, between(0.05, 0.3), between(0.55, 0.7))) for h in (0.03, 0.08, 0.11, 0.6)]
        self.container = self.plaster[0] if self.often(SHARED) else self.material(plain, pale, scale_m=1.0)
        tiles = ((0.03, 0.35, 0.46), grey, pale)
        self.roofs = [self.material(Pattern.STRIPES, tile, scale_m=0.9, dim=0.7) for tile in tiles]
        self.metal = [self.material(plain, (0.6, 0.05, v), scale_m=0.6, dim=0.6) for v in (0.35, 0.52, 0.68)]
        self.glass = self.material(plain, (0.58, 0.2, 0.2), scale_m=1.5)
        self.wood = self.material(Pattern.STRIPES, (0.08, between(0.2, 0.4), between(0.35, 0.55)), scale_m=0.4)
        lacquers = [(0.03, 0.4, 0.48), green, (between(0.5, 0.7), 0.5, 0.5), pale, grey]
        lacquers += [(0.6, 0.05, v) for v in (0.15, 0.35, 0.6, 0.76)]
        self.lacquers = [self.material(plain, lacquer, scale_m=1.5, dim=0.85) for lacquer in lacquers]

    def between(self, low: float, high: float) -> float:
        """A random number."""
        return float(self.rng.uniform(low, high))

    def often(self, probability: float) -> bool:
        """Whether something happens."""
        return bool(self.rng.uniform() < probability)

    def pick(self, items: list[int]) -> int:
        """A random one."""
        return items[int(self.rng.integers(len(items)))]

    def material(self, pattern: Pattern, hsv: Color, *, scale_m: float, dim: float = 0.8) -> int:
        """A new material whose second colour is ``dim`` times the first; returns its number."""
        a = display_hsv(*hsv)
        return self._add(pattern, a, (a[0] * dim, a[1] * dim, a[2] * dim), scale_m)

    def place(
        self, assembly: Assembly, x: float, y: float, *, z: float = 0.0, yaw: float = 0.0, tilt: float = 0.0
    ) -> None:
        """Put an assembly down, turned by ``yaw`` about z and then by ``tilt`` about the world's x axis."""
        turn = rotation_x(tilt) @ rotation_z(yaw)
        self.groups.append(turned_parts(assembly, turn, np.array([x, y, z])))

    def _add(self, pattern: Pattern, a: Color, b: Color, scale_m: float) -> int:
        self.materials.append(Material(pattern, a, b, scale_m, int(self.rng.integers(1 << 30))))
        return len(self.materials) - 1

    def _front(self, hsv: Color) -> int:
        """A front with a window of glass every 3 m."""
        return self._add(Pattern.WINDOWS, display_hsv(*hsv), display_hsv(0.58, 0.2, self.between(0.2, 0.3)), STOREY_M)
