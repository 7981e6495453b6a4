"""Furniture builders: what every specimen must hold to."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes.furniture import FURNITURE
from semantic_mapper.scenes.materials import Palette
from semantic_mapper.scenes.programmes import CLUTTER, PROGRAMMES, SHARES

SPECIMENS = 12
STANDING = [name for name, kind in FURNITURE.items() if kind.place in ("wall", "corner", "centre", "small")]


def specimens(name: str):
    for seed in range(SPECIMENS):
        rng = np.random.default_rng(seed)
        yield FURNITURE[name].make(rng, Palette(rng))


@pytest.mark.parametrize("name", STANDING)
def test_furniture_stands_on_the_floor(name: str) -> None:
    for assembly in specimens(name):
        assert assembly.bounds()[0][2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("name", sorted(FURNITURE))
def test_parts_have_volume_and_a_known_class(name: str) -> None:
    for assembly in specimens(name):
        for part in assembly.parts:
            assert part.half.min() > 0
            assert part.label in ROOMS.names
            np.testing.assert_allclose(part.rotation @ part.rotation.T, np.eye(3), atol=1e-12)


def test_every_specimen_can_differ() -> None:
    for name in FURNITURE:
        sizes = {tuple(np.round(a.bounds()[1] - a.bounds()[0], 6)) for a in specimens(name)}
        colours = {tuple(p.material for p in a.parts) for a in specimens(name)}
        assert len(sizes) + len(colours) > 2, name


def test_programmes_name_registered_furniture_and_their_shares_add_up() -> None:
    sets = {"bed_set", "sofa_set", "desk_set", "dining_set"}
    named = {entry.name for entries in PROGRAMMES.values() for entry in entries} | set(CLUTTER)
    assert named - sets <= set(FURNITURE)
    assert set(SHARES) == set(PROGRAMMES)
    assert sum(SHARES.values()) == pytest.approx(1.0)


def test_each_pool_of_materials_serves_several_classes() -> None:
    """Colour alone must not tell the class: e.g. a door and a cabinet may have the very same wood."""
    users: dict[int, set[str]] = {}
    for seed in range(40):
        palette = Palette(np.random.default_rng(0))
        for name in FURNITURE:
            for part in FURNITURE[name].make(np.random.default_rng(seed), palette).parts:
                users.setdefault(part.material, set()).add(part.label)
    for pair in ({"door", "cabinet"}, {"desk", "table"}, {"curtain", "sofa"}, {"refrigerator", "cabinet"}):
        assert any(pair <= classes for classes in users.values()), pair
