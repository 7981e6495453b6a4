"""Furniture builders: what every specimen must hold to."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes.furniture import FURNITURE
from research.scenes.materials import CAMOUFLAGE, HELD_OUT_HUES, Draw, Palette
from research.scenes.room_templates import CLUTTER, CYCLE, ROOM_TEMPLATES
from semantic_mapper.labels import ROOMS

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


def test_programmes_name_registered_furniture() -> None:
    sets = {"bed_set", "sofa_set", "desk_set", "dining_set", "mat"}
    named = {entry.name for entries in ROOM_TEMPLATES.values() for entry in entries}
    named |= {name for names in CLUTTER.values() for name in names}
    assert named - sets <= set(FURNITURE)
    assert set(CYCLE) == set(CLUTTER) == set(ROOM_TEMPLATES)


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


def test_camouflaged_pairs_share_one_material_in_about_a_third_of_the_rooms() -> None:
    palettes = [Palette(np.random.default_rng(seed)) for seed in range(200)]
    for first, second, _ in CAMOUFLAGE:
        shared = [p.camouflage.get(first, -1) == p.camouflage.get(second, -2) for p in palettes]
        assert 0.2 < np.mean(shared) < 0.5, (first, second)


@pytest.mark.parametrize("fraction", [0.0, 0.8, 1.0])
def test_a_palette_camouflages_as_many_pairs_as_it_is_asked_to(fraction: float) -> None:
    palettes = [Palette(np.random.default_rng(seed), camouflage=fraction) for seed in range(100)]
    shared = [a in p.camouflage and p.camouflage[a] == p.camouflage.get(b) for p in palettes for a, b, _ in CAMOUFLAGE]
    assert np.mean(shared) == pytest.approx(fraction, abs=0.06)


@pytest.mark.parametrize(
    ("pair", "pieces", "labels"),
    [
        (0, ("door", "wardrobe"), ("door", "cabinet")),
        (1, ("desk", "dining_table"), ("desk", "table")),
        (2, ("bathtub", "sofa"), ("curtain", "sofa")),
        (4, ("refrigerator", "larder"), ("refrigerator", "cabinet")),
    ],
)
def test_a_camouflaged_room_uses_the_shared_material_on_both(
    pair: int, pieces: tuple[str, str], labels: tuple[str, str]
) -> None:
    first, second, _ = CAMOUFLAGE[pair]
    shared = next(
        p for p in (Palette(np.random.default_rng(s)) for s in range(99)) if {first, second} <= p.camouflage.keys()
    )
    for piece, label in zip(pieces, labels, strict=True):
        used = {
            part.material
            for seed in range(SPECIMENS)
            for part in FURNITURE[piece].make(np.random.default_rng(seed), shared).parts
            if part.label == label
        }
        assert shared.camouflage[first] in used, piece


def test_training_rooms_leave_out_hues_that_held_out_rooms_are_fond_of() -> None:
    def share(held_out: bool) -> float:
        draw = Draw(np.random.default_rng(0), held_out)
        hues = [draw.hue() for _ in range(2000)]
        return float(np.mean([any(low <= hue < high for low, high in HELD_OUT_HUES) for hue in hues]))

    assert share(held_out=False) == 0
    assert share(held_out=True) > 0.5
