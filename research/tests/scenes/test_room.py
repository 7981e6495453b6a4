"""Rooms: determinism, placement, class coverage, refusals."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from research.scenes import TEST_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS, RoomConfig, Scene, make_room
from research.scenes.camera import pose_of
from research.scenes.render import cast_view
from research.scenes.room_templates import ROOM_TEMPLATES
from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics

SEEDS = range(20)


@pytest.fixture(scope="module")
def rooms() -> list[Scene]:
    return [make_room(seed, RoomConfig(shadow_resolution=8)) for seed in SEEDS]


def test_a_seed_gives_the_same_room_twice() -> None:
    a, b = make_room(7), make_room(7)
    assert (a.template, a.size_m) == (b.template, b.size_m)
    for part in ("primitives", "materials", "lights"):
        first, second = getattr(a, part), getattr(b, part)
        for name in first.__slots__:
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_another_seed_gives_another_room() -> None:
    assert make_room(7).size_m != make_room(8).size_m


def test_splits_share_no_seed_and_stay_below_the_reserved_ones() -> None:
    splits = [set(TRAIN_SEEDS), set(VALIDATION_SEEDS), set(TEST_SEEDS)]
    assert sum(map(len, splits)) == len(set.union(*splits))
    assert max(set.union(*splits)) < 300_000


def test_twenty_rooms_show_every_class(rooms: list[Scene]) -> None:
    seen = np.unique(np.concatenate([room.primitives.label for room in rooms]))
    missing = [name for i, name in zip(ROOMS.ids, ROOMS.names, strict=True) if i not in seen]
    assert missing == ["person"], "nobody is there unless asked for"


def test_rooms_have_as_many_primitives_as_planned(rooms: list[Scene]) -> None:
    counts = [len(room.primitives) for room in rooms]
    assert min(counts) >= 55
    assert 130 <= np.median(counts) <= 200


def test_furniture_stands_inside_the_room_or_beyond_an_opening_but_never_in_a_wall(rooms: list[Scene]) -> None:
    beyond = 0
    for room in rooms:
        low, high = room.primitives.bounds()
        size = np.array(room.size_m)
        for group in range(6, int(room.primitives.group.max()) + 1):
            mine = room.primitives.group == group
            own_low, own_high = low[mine].min(0), high[mine].max(0)
            inside = (own_low >= -1e-6).all() and (own_high <= size + 1e-6).all()
            outside = (own_high <= 0.002).any() or (own_low >= size - 0.002).any()
            door_frame = room.primitives.label[mine][0] == ROOMS.ids[ROOMS.names.index("door")]
            assert inside or outside or door_frame
            beyond += bool(outside)
    assert beyond > 10


def test_some_rooms_open_into_a_next_one_that_is_closed(rooms: list[Scene]) -> None:
    """A camera at the opening, looking through it, meets surfaces everywhere."""
    ceiling = ROOMS.ids[ROOMS.names.index("ceiling")]
    opened = [room for room in rooms if (room.primitives.label == ceiling).sum() > 1]
    assert 3 <= len(opened) <= 15
    camera = CameraIntrinsics(20.0, 20.0, 19.5, 14.5, 40, 30)
    for room in opened:
        middle = np.append(np.array(room.size_m[:2]) / 2, 1.4)
        other = room.primitives.center[np.flatnonzero(room.primitives.label == ceiling)[1]]
        toward = other[:2] - middle[:2]
        pose = pose_of(middle, float(np.arctan2(toward[1], toward[0])), 0.0)
        _, index = cast_view(room, camera, pose)
        assert (index >= 0).all()


def test_every_kind_of_light_source_and_mirror_occurs(rooms: list[Scene]) -> None:
    lit = [len(room.lights.position) for room in rooms]
    assert min(lit) >= 1
    assert np.median(lit) >= 3
    mirrors = [(room.materials.mirror[room.primitives.material] > 0).any() for room in rooms]
    assert sum(mirrors) >= 4


def test_furniture_does_not_interpenetrate(rooms: list[Scene]) -> None:
    """Boxes round parts of different pieces are apart; parts of one piece (neighbours in instance number) may touch."""
    for room in rooms:
        groups = room.primitives.group
        low, high = room.primitives.bounds()
        # Walls and what lies flat (rugs) are met by furniture on purpose; bounds of turned parts are loose by nature.
        solid = (high[:, 2] > 0.02) & (groups >= 6)
        low, high, groups = low[solid], high[solid], groups[solid]
        overlap = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
        deep = (overlap.min(-1) > 1e-3) & (groups[:, None] != groups[None])
        assert not deep.any()


@pytest.mark.parametrize("template", sorted(ROOM_TEMPLATES))
def test_a_programme_can_be_asked_for(template: str) -> None:
    config = RoomConfig(template=template, shadow_resolution=8)  # type: ignore[arg-type]
    assert make_room(3, config).template == template


def test_camouflage_changes_materials_but_not_where_things_stand() -> None:
    plain, hidden = (make_room(0, RoomConfig(shadow_resolution=8, camouflage=f)) for f in (0.0, 1.0))
    np.testing.assert_array_equal(plain.primitives.center, hidden.primitives.center)
    assert (plain.primitives.material != hidden.primitives.material).any()


def test_main_furniture_is_nearly_always_there() -> None:
    wanted = {"bedroom": "bed", "living": "sofa", "office": "desk", "kitchen": "counter", "bathroom": "toilet"}
    for template, label in wanted.items():
        config = RoomConfig(template=template, shadow_resolution=8)  # type: ignore[arg-type]
        rooms = [make_room(seed, config) for seed in range(10)]
        there = sum(ROOMS.ids[ROOMS.names.index(label)] in room.primitives.label for room in rooms)
        assert there >= 8, (template, there)


@pytest.mark.parametrize(
    "config",
    [
        RoomConfig(min_side_m=5.0, max_side_m=4.0),
        RoomConfig(min_side_m=1.0),
        RoomConfig(max_height_m=2.0),
        RoomConfig(clutter=-1.0),
        RoomConfig(template="castle"),  # type: ignore[arg-type]
    ],
)
def test_impossible_settings_are_refused(config: RoomConfig) -> None:
    with pytest.raises(ConfigError):
        make_room(0, config)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ConfigError, match="negative"):
        make_room(-1)


def test_settings_are_plain_data() -> None:
    config = RoomConfig(template="kitchen", clutter=0.5)
    assert msgspec.convert(msgspec.to_builtins(config), RoomConfig) == config
