"""``make_room``: one furnished room from a seed."""

from __future__ import annotations

import numpy as np

from research.scenes.config import SUITE_VERSION, TRAIN_SEEDS, RoomConfig
from research.scenes.layout import Layout
from research.scenes.materials import Palette
from research.scenes.people import add_beings
from research.scenes.primitives import Primitives, pack
from research.scenes.room_templates import CYCLE, ROOM_TEMPLATES, furnish
from research.scenes.scene import Lights, Scene, extremes, shadow_cubes
from research.scenes.turned import make_turned_room
from semantic_mapper.errors import ConfigError

_GLARE = 0.35  # fraction of the rooms with one hard, strong light
_PEOPLE_STREAM = 3
_VARIETY_STREAM = 4
_ROOM_STREAM = 0  # number of the random stream; camera paths use others


def make_room(seed: int, config: RoomConfig = RoomConfig()) -> Scene:
    """Build the room of ``seed``; the same (suite version, seed, config) always gives the same room.

    Raises ConfigError: negative seed, or bounds of ``config`` that leave nothing to choose.
    """
    _check(seed, config)
    if config.style == "turned":
        return make_turned_room(seed, config)
    rng = np.random.default_rng((SUITE_VERSION, seed, _ROOM_STREAM))
    template = config.template or CYCLE[seed % len(CYCLE)]
    size = _room_size(rng, template, config)
    palette = Palette(rng, held_out=seed not in TRAIN_SEEDS, camouflage=config.camouflage)
    variety = np.random.default_rng((SUITE_VERSION, seed, _VARIETY_STREAM))
    varied = variety.uniform() < config.variety
    layout = Layout(size, rng, palette, wet=template == "bathroom", variety=variety if varied else None)
    furnish(layout, template, config.clutter)
    # A stream of its own: the room is the same with and without people in it.
    others = np.random.default_rng((SUITE_VERSION, seed, _PEOPLE_STREAM))
    walks = add_beings(layout, others) if others.uniform() < config.people else ()
    primitives = pack(layout.groups)
    lights = _make_lights(rng, primitives, layout, config.shadow_resolution)
    return Scene(seed, template, size, primitives, palette.table(), lights, walks)


def _check(seed: int, config: RoomConfig) -> None:
    if seed < 0:
        raise ConfigError(f"room seed {seed} is negative; seeds count from 0")
    if not 2.4 <= config.min_side_m <= config.max_side_m:
        raise ConfigError(
            f"RoomConfig: need 2.4 <= min_side_m <= max_side_m, got {config.min_side_m} and {config.max_side_m}"
        )
    if not 2.2 <= config.min_height_m <= config.max_height_m:
        raise ConfigError(
            f"RoomConfig: need 2.2 <= min_height_m <= max_height_m, got {config.min_height_m} and {config.max_height_m}"
        )
    if config.template is not None and config.template not in ROOM_TEMPLATES:
        raise ConfigError(f"RoomConfig: no template '{config.template}'; there are {', '.join(ROOM_TEMPLATES)}")
    if config.clutter < 0 or config.shadow_resolution < 8:
        raise ConfigError("RoomConfig: clutter must not be negative, shadow_resolution must be at least 8")


def _room_size(rng: np.random.Generator, template: str, config: RoomConfig) -> tuple[float, float, float]:
    largest = min(config.max_side_m, config.min_side_m + 0.8) if template == "bathroom" else config.max_side_m
    w, d = rng.uniform(config.min_side_m, largest, 2)
    return float(w), float(d), float(rng.uniform(config.min_height_m, config.max_height_m))


def _make_lights(rng: np.random.Generator, primitives: Primitives, layout: Layout, shadow_resolution: int) -> Lights:
    """Two to five of the room's lamps and windows are lit, and the next room's lamp where an opening shows it.

    Strengths add up to an evenly exposed picture, but in ``_GLARE`` of the rooms one of the lights is so strong and
    hard that what is near it burns out and corners are dim.
    """
    size, lamps = layout.size_m, layout.lamps
    order = rng.permutation(len(lamps)) if lamps else np.zeros(0, int)
    chosen = [lamps[i] for i in order[: int(rng.integers(2, 6))]]
    if not chosen:
        chosen = [np.array([size[0] / 2, size[1] / 2, size[2] - 0.3])]
    shares = rng.uniform(0.3, 1.7, len(chosen))
    strength = rng.uniform(3.0, 6.0) * (size[0] * size[1] / 16.0) ** 0.5 * shares / shares.sum()
    softness, dim = rng.uniform(0.35, 1.0, len(chosen)), rng.uniform(0.5, 1.0)
    if rng.uniform() < _GLARE:
        strength[0] = strength[0] * rng.uniform(2.0, 5.0) + 1.5
        softness[0] = 0.2
        dim = rng.uniform(0.25, 0.6)
    if layout.far_lamp is not None:
        chosen.append(layout.far_lamp)
        strength, softness = np.append(strength, rng.uniform(0.2, 3.0)), np.append(softness, 0.7)
    warm = np.clip(rng.normal(0.0, 0.8, (len(chosen), 1)), -1.8, 1.8)  # of one room, lamps differ in colour
    tint = 1.0 + warm * np.array([[0.16, 0.02, -0.24]]) + rng.uniform(-0.05, 0.05, (len(chosen), 3))
    position = np.array(chosen)
    cubes = shadow_cubes(primitives, position, shadow_resolution)
    ambient = 0.42 * dim * (1.0 + rng.uniform(-0.12, 0.12, 3))
    return Lights(position, tint * strength[:, None], cubes, *extremes(cubes), softness, ambient)
