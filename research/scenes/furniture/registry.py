"""The table of furniture builders. A new piece is one function with ``@furniture`` above it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from research.scenes.materials import Palette
from research.scenes.primitives import Assembly

Place = Literal["wall", "corner", "centre", "hang", "ceiling", "small"]
Builder = Callable[[Assembly, np.random.Generator, Palette], None]


@dataclass(frozen=True, slots=True)
class Furniture:
    """One kind of furniture.

    Args:
        name: Key in ``FURNITURE``.
        label: Class of its parts, unless a part says otherwise.
        place: Where it goes: at a wall, preferably in a corner, free in the room, hung on a wall, under the ceiling,
            or (small) on top of other furniture.
        build: Adds the parts.
        keep_free_m: Space to leave in front of it.
    """

    name: str
    label: str
    place: Place
    build: Builder
    keep_free_m: float

    def make(self, rng: np.random.Generator, palette: Palette) -> Assembly:
        """A random specimen."""
        assembly = Assembly(self.label, keep_free_m=self.keep_free_m)
        self.build(assembly, rng, palette)
        return assembly


FURNITURE: dict[str, Furniture] = {}


def furniture(label: str, place: Place, *, keep_free_m: float = 0.0) -> Callable[[Builder], Builder]:
    """Register a builder under its function's name."""

    def register(build: Builder) -> Builder:
        FURNITURE[build.__name__] = Furniture(build.__name__, label, place, build, keep_free_m)
        return build

    return register
