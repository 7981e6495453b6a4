"""What streets are made with: random numbers, materials, where parts are put, and the sky's clouds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from research.scenes.materials import Color, Material, Pattern, display_hsv
from research.scenes.primitives import Assembly, Part, place_parts
from semantic_mapper.types import Float32, Float64

SHARED = 0.3  # probability that two classes of a pair share one material


class StreetBuilder:
    """Collects materials and parts.

    Args:
        rng: Of everything that is drawn.
        origin: (3,) metres, where coordinates begin.
    """

    def __init__(self, rng: np.random.Generator, origin: Float64) -> None:
        self.rng, self.origin = rng, origin
        self.materials: list[Material] = []
        self.groups: list[list[Part]] = []
        self.grey = [self.material(Pattern.PLAIN, (0.6, 0.03, v), scale_m=0.4) for v in (0.42, 0.62, 0.9)]
        self.glass = [self.material(Pattern.PLAIN, (0.58, 0.2, v), gloss=0.6, scale_m=1.5) for v in (0.15, 0.3)]
        self.wood = [self.material(Pattern.WOOD, (0.08, s, v), scale_m=0.08) for s, v in ((0.4, 0.5), (0.15, 0.85))]
        leaves = ((0.27, 0.6, 0.45), (0.22, 0.5, 0.5), (0.3, 0.45, 0.35))
        self.leaves = [self.material(Pattern.PRINT, hsv, scale_m=0.3, dim=0.3) for hsv in leaves]

    def between(self, low: float, high: float) -> float:
        """A random number."""
        return float(self.rng.uniform(low, high))

    def pick(self, items: list[int]) -> int:
        """A random one."""
        return items[int(self.rng.integers(len(items)))]

    def material(self, pattern: Pattern, hsv: Color, *, scale_m: float, dim: float = 0.8, gloss: float = 0.0) -> int:
        """A new material whose second colour is ``dim`` times the first; returns its number."""
        a = display_hsv(*hsv)
        b = (a[0] * dim, a[1] * dim, a[2] * dim)
        self.materials.append(Material(pattern, a, b, scale_m, int(self.rng.integers(1 << 30)), gloss=gloss))
        return len(self.materials) - 1

    def place(self, assembly: Assembly, x: float, y: float, *, z: float = 0.0, yaw: float = 0.0) -> None:
        """Put an assembly down."""
        self.groups.append(place_parts(assembly, yaw, self.origin + np.array([x, y, z])))


class SuiteBuilder(StreetBuilder):
    """A builder with the materials of STREETS, some of which two classes share."""

    def __init__(self, rng: np.random.Generator, origin: Float64) -> None:
        super().__init__(rng, origin)
        plain, tiles, between = Pattern.PLAIN, Pattern.TILES, self.between
        asphalt = (0.6, 0.05, between(0.4, 0.5))
        self.asphalt = self.material(plain, asphalt, scale_m=0.6, dim=0.72)
        self.parking = self.either(self.asphalt, lambda: self.material(tiles, asphalt, scale_m=0.25, dim=0.7))
        pale = (between(0.06, 0.11), between(0.04, 0.12), between(0.56, 0.66))
        self.paving = self.material(tiles, pale, scale_m=0.45, dim=0.7)
        self.paint = self.material(plain, (0.1, 0.03, 0.85), scale_m=0.3, dim=0.8)
        green = (between(0.2, 0.27), between(0.4, 0.5), between(0.42, 0.5))
        self.grass = self.material(Pattern.PRINT, green, scale_m=0.4, dim=0.55)
        self.leaves = [*self.leaves, self.grass] if between(0, 1) < SHARED else self.leaves
        self.fields = [self.material(plain, (h, 0.4, 0.5), scale_m=6.0, dim=0.7) for h in (0.13, 0.22)]
        hues = [(0.09, 0.12, 0.82), (0.11, 0.3, 0.85), (0.05, 0.25, 0.75), (0.58, 0.08, 0.75), (0.08, 0.04, 0.93)]
        self.plaster = [self.material(plain, hue, scale_m=1.2, dim=0.88) for hue in hues]
        self.plaster.append(self.material(tiles, (0.03, 0.4, 0.5), scale_m=0.24, dim=0.75))  # brick
        stone = (between(0.05, 0.1), 0.12, 0.6)
        self.stone = self.either(self.pick(self.plaster), lambda: self.material(tiles, stone, scale_m=0.3, dim=0.65))
        self.board = self.pick(self.wood)
        metal = (0.4, 0.2, 0.25)
        self.gate = self.either(self.board, lambda: self.material(plain, metal, scale_m=1.0, dim=0.9))
        lacquers = [(0.6, 0.04, v) for v in (0.12, 0.3, 0.55, 0.75)] + [(h, 0.65, 0.55) for h in (0.0, 0.6, 0.62)]
        self.lacquers = [self.lacquer(hsv) for hsv in lacquers]
        self.white = self.lacquer((0.1, 0.03, 0.9))
        self.lacquers.append(self.white)
        self.caravan = self.either(self.white, lambda: self.lacquer((0.11, 0.08, 0.86)))
        self.trailer = self.either(self.white, lambda: self.lacquer((0.6, 0.05, 0.6)))

        self.rubber = self.material(plain, (0.6, 0.05, 0.1), scale_m=0.3)
        self.red = self.lacquer((0.0, 0.85, 0.6))
        self.paints = [self.material(plain, hsv, scale_m=0.4) for hsv in ((0.33, 0.5, 0.3), (0.6, 0.5, 0.4))]
        self.paints += [self.grey[0], self.material(plain, (0.12, 0.8, 0.7), scale_m=0.4)]

    def either(self, shared: int, make: Callable[[], int]) -> int:
        """A material of another class, now and then; else one of its own."""
        return shared if self.rng.uniform() < SHARED else make()

    def lacquer(self, hsv: tuple[float, float, float]) -> int:
        """A new lacquer."""
        return self.material(Pattern.PLAIN, hsv, scale_m=1.0, gloss=0.4, dim=0.95)


def clouds(rng: np.random.Generator) -> Float32:
    """(256, 256) cover of the sky, which goes on over its edges."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    spectrum = np.fft.fft2(rng.standard_normal((256, 256))) / np.maximum(frequency, 1 / 256) ** 1.7
    clouds = np.fft.ifft2(spectrum).real
    clouds = (clouds - clouds.mean()) / clouds.std()
    return np.clip(0.5 * clouds + rng.uniform(-0.4, 0.5), 0, 1).astype(np.float32)
