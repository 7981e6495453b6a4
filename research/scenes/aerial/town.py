"""Towns: a grid of streets round blocks, a river through one of its rows, and bridges over it.

Everything is a pure function of (version, seed). The centre of the town is the origin; x runs along the river, z is up,
and streets lie at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.aerial import blocks, streets
from research.scenes.aerial.builder import TownBuilder
from research.scenes.aerial.plan import RIVER_ROW_M, TownPlan
from research.scenes.daylight import Daylight, shadow_map, sun_camera
from research.scenes.materials import display_hsv, material_table
from research.scenes.primitives import pack
from research.scenes.scene import NO_LAMPS, Scene
from semantic_mapper.labels import CARLA

AERIAL_VERSION = 3  # part of every seed: a change that alters a town raises it
AERIAL_CODE = 2207  # tells the random streams of this suite from those of others
MAY_LACK = ("truck", "bus", "fence", "static", "dynamic", "pedestrian", "trafficsign", "trafficlight")

_SCENE_STREAM = 0
_BLOCK_M = {3: (48.0, 52.0), 4: (42.0, 46.0), 5: (38.0, 41.0)}  # side of a block with its street, by blocks a side
_FULL_BLOCKS = 8  # towns with more blocks have emptier ones, so that 1,500 primitives do
_SUN_M, _SHADOW_SIZE = 4000.0, 2048
_SHADOW_BIAS_M = 0.25
_SKY_SHADE = 0.6  # light of the sky, as a fraction of the sun's
_HAZE_M = 4000.0


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """A town with what its scene does not tell.

    Args:
        scene: Label set ``CARLA``; the sky has no class.
        plan: Where streets and river are.
        asphalt: Number of the material of streets, bridges and flat roofs.
        lacking: Classes of which it has none.
    """

    scene: Scene
    plan: TownPlan
    asphalt: int
    lacking: frozenset[str]


def make_town(seed: int) -> Town:
    """The town of ``seed``."""
    rng = np.random.default_rng((AERIAL_CODE, AERIAL_VERSION, seed, _SCENE_STREAM))
    columns, rows = int(rng.integers(3, 6)), int(rng.integers(3, 6))
    river = int(rng.integers(1, rows - 1))
    wide = [float(rng.uniform(*_BLOCK_M[columns])) for _ in range(columns)]
    deep = [RIVER_ROW_M if k == river else float(rng.uniform(*_BLOCK_M[rows])) for k in range(rows)]
    bridges = sorted(int(k) for k in rng.permutation(np.arange(1, columns))[: int(rng.integers(1, 3))])
    plan = TownPlan(_middled(wide), _middled(deep), river, tuple(bridges))
    lacking = frozenset(MAY_LACK[k] for k in rng.permutation(len(MAY_LACK))[: int(rng.integers(0, 3))])
    b = TownBuilder(rng, min(1.0, _FULL_BLOCKS / (columns * (rows - 1))))
    streets.lay_ground(b, plan)
    streets.lay_streets(b, plan)
    streets.build_bridges(b, plan)
    blocks.fill_blocks(b, plan, lacking)
    streets.fill_streets(b, plan, lacking)
    primitives = pack(b.groups, CARLA)
    sun, T_world_sun = sun_camera(np.zeros(3), b.between(0, 2 * np.pi), np.radians(b.between(62, 74)), _SUN_M)
    focal = _SHADOW_SIZE / 2 * _SUN_M / (plan.reach_m + 40.0)
    shadow = shadow_map(primitives, T_world_sun, focal, _SHADOW_SIZE)
    sky = display_hsv(0.57, 0.12, 0.97), display_hsv(0.6, 0.45, 0.85)
    daylight = Daylight(None, sun, shadow, T_world_sun, focal, _SHADOW_BIAS_M, _SKY_SHADE, sky, None, _HAZE_M)
    nowhere = (np.inf, np.inf, np.inf)
    table = material_table(b.materials)
    scene = Scene(seed, "town", nowhere, primitives, table, NO_LAMPS, (), CARLA, daylight)
    return Town(scene, plan, b.asphalt, lacking)


def _middled(sizes: list[float]) -> tuple[float, ...]:
    """Edges between intervals of these sizes that lie evenly round 0."""
    edges = np.concatenate(([0.0], np.cumsum(sizes)))
    return tuple(float(x) for x in edges - edges[-1] / 2)
