"""What stands in which kind of room, and the little scenes that furniture forms (chairs at a table)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from research.scenes.furniture import FURNITURE
from research.scenes.layout import Layout
from research.scenes.primitives import Assembly, rotation_z


@dataclass(frozen=True, slots=True)
class Entry:
    """``most`` tries of a piece or set, each with ``chance``."""

    name: str
    chance: float = 1.0
    most: int = 1


_WINDOW = Entry("window", 0.9)
_WALLS = (
    Entry("window", 0.5), Entry("radiator", 0.4), Entry("picture", 0.75, 4), Entry("wall_shelf", 0.4),
    Entry("notices", 0.35, 2), Entry("wall_clock", 0.3), Entry("wall_mirror", 0.2), Entry("coat_hooks", 0.2),
)  # fmt: skip
_LOOSE = (
    Entry("plant", 0.45), Entry("floor_lamp", 0.35), Entry("waste_bin", 0.35), Entry("carton", 0.3, 2),
    Entry("bag", 0.35), Entry("shoes", 0.4, 2), Entry("basket", 0.25), Entry("ball", 0.2),
)  # fmt: skip

ROOM_TEMPLATES: dict[str, tuple[Entry, ...]] = {
    "bedroom": (
        Entry("bed_set"), _WINDOW,
        Entry("wardrobe", 0.8), Entry("dresser", 0.6), Entry("desk_set", 0.45),
        Entry("bookshelf", 0.3), Entry("cube_shelf", 0.25), Entry("armchair", 0.35), Entry("pouf", 0.3),
        Entry("television", 0.2), *_WALLS, *_LOOSE,
    ),
    "living": (
        Entry("sofa_set"), _WINDOW,
        Entry("sideboard", 0.8), Entry("bookshelf", 0.6), Entry("armchair", 0.7), Entry("cube_shelf", 0.35),
        Entry("ladder_shelf", 0.3), Entry("dining_set", 0.45), Entry("dresser", 0.4), Entry("side_table", 0.5),
        Entry("pouf", 0.35), Entry("television", 0.3), *_WALLS, *_LOOSE,
    ),
    "office": (
        Entry("desk_set"), _WINDOW,
        Entry("desk_set", 0.6), Entry("bookshelf", 0.8), Entry("filing_cabinet", 0.7), Entry("cube_shelf", 0.4),
        Entry("ladder_shelf", 0.2), Entry("dresser", 0.3), Entry("wardrobe", 0.3), Entry("dining_set", 0.35),
        Entry("open_rack", 0.5), *_WALLS, *_LOOSE,
    ),
    "kitchen": (
        Entry("counter"), _WINDOW,
        Entry("refrigerator", 0.95), Entry("stove", 0.75), Entry("dining_set", 0.75), Entry("larder", 0.45),
        Entry("counter", 0.35), Entry("kitchen_island", 0.3), Entry("dresser", 0.2), Entry("open_rack", 0.3),
        Entry("stool", 0.2), *_WALLS, *_LOOSE,
    ),
    "bathroom": (
        Entry("bathtub", 0.75), Entry("toilet"), Entry("wash_basin", 0.95), Entry("shower", 0.5),
        Entry("wash_basin", 0.25), Entry("dresser", 0.25), Entry("wall_cabinet", 0.45), Entry("stool", 0.4), _WINDOW,
        Entry("towel_rail", 0.8, 2), Entry("open_rack", 0.35), Entry("toilet_roll", 0.7), Entry("basket", 0.5),
        Entry("picture", 0.4, 2), Entry("radiator", 0.5), Entry("waste_bin", 0.5), Entry("wall_mirror", 0.2),
        Entry("plant", 0.25), Entry("wall_shelf", 0.4), Entry("mat", 0.3),
    ),
    "studio": (
        Entry("bed_set"), _WINDOW,
        Entry("counter", 0.8), Entry("refrigerator", 0.8), Entry("sofa_set", 0.6), Entry("desk_set", 0.35),
        Entry("dining_set", 0.5), Entry("bookshelf", 0.4), Entry("cube_shelf", 0.3), Entry("wardrobe", 0.5),
        Entry("television", 0.25), *_WALLS, *_LOOSE,
    ),
}  # fmt: skip

# The template of a seed is CYCLE[seed % 20], so that any 20 rooms in a row, and each split, have the same mix:
# kitchens and bathrooms more often than homes have them, since their furniture is small in the picture.
CYCLE = (
    "kitchen", "bathroom", "living", "bedroom", "bathroom", "office", "kitchen", "bathroom", "studio", "living",
    "kitchen", "bedroom", "bathroom", "kitchen", "living", "office", "bathroom", "kitchen", "bedroom", "studio",
)  # fmt: skip

_COMMON = (
    "cup", "cup", "bottle", "bowl", "book_pile", "vase", "small_box", "potted_plant", "magazines", "magazines",
    "leaflet", "open_book", "cable",
)  # fmt: skip
_KITCHEN = (
    "kettle", "pan", "pan", "microwave", "dish_rack", "bottle", "cutting_board", "packets", "packets", "coffee_machine",
    "toaster", "utensils", "tableware", "standing_books",
)  # fmt: skip
CLUTTER: dict[str, tuple[str, ...]] = {
    "bedroom": (*_COMMON, "table_lamp", "table_lamp", "photo_frame", "photo_frame", "laptop", "folded_towels"),
    "living": (*_COMMON, "table_lamp", "photo_frame", "photo_frame", "laptop", "standing_books", "tableware"),
    "office": (
        "cup", "book_pile", "small_box", "potted_plant", "paper_pile", "paper_pile", "laptop", "table_lamp",
        "magazines", "standing_books", "leaflet", "utensils", "cable", "open_book",
    ),
    "kitchen": (*_COMMON, *_KITCHEN),
    "bathroom": (
        "soap_set", "soap_set", "bottle", "bottle", "cup", "small_box", "folded_towels", "potted_plant", "utensils",
        "packets", "cable", "magazines",
    ),
    "studio": (*_COMMON, *_KITCHEN, "table_lamp", "photo_frame", "laptop"),
}  # fmt: skip

_ODD = ("odd_thing",) * 6
_BOARD = ("tray", "mixing_bowl", "board", "board", "jug")

# What varied rooms hold before all else, and on their tables beside what others do (``RoomConfig.variety``).
VARIED: dict[str, tuple[Entry, ...]] = {
    "bedroom": (Entry("open_cupboard", 0.6), Entry("any_table", 0.2)),
    "living": (Entry("any_table", 0.6), Entry("open_cupboard", 0.5)),
    "office": (Entry("any_table", 0.6), Entry("open_cupboard", 0.5)),
    "kitchen": (
        Entry("corner_counter", 0.6), Entry("any_refrigerator", 0.9), Entry("any_table", 0.9),
        Entry("open_cupboard", 0.4),
    ),
    "bathroom": (Entry("open_cupboard", 0.4),),
    "studio": (Entry("any_refrigerator", 0.6), Entry("any_table", 0.6), Entry("open_cupboard", 0.4)),
}  # fmt: skip
VARIED_CLUTTER: dict[str, tuple[str, ...]] = {
    "bedroom": ("tray", "jug", *_ODD), "living": (*_BOARD, *_ODD), "office": ("tray", *_ODD),
    "kitchen": (*_BOARD, *_BOARD, *_ODD), "bathroom": ("jug", "tray", *_ODD), "studio": (*_BOARD, *_ODD),
}  # fmt: skip


def furnish(layout: Layout, template: str, clutter: float) -> None:
    """Fill ``layout`` after ``ROOM_TEMPLATES[template]``."""
    if not layout.has_opening or layout.rng.uniform() < 0.4:
        _place(layout, "door")
    more = () if layout.variety is None else VARIED[template]
    for entry in (*more, *ROOM_TEMPLATES[template]):
        for _ in range(entry.most):
            if layout.rng.uniform() < entry.chance:
                _place(layout, entry.name)
    _ceiling_lamps(layout)
    if clutter > 0:
        names = CLUTTER[template] if layout.variety is None else (*CLUTTER[template], *VARIED_CLUTTER[template])
        layout.clutter(clutter, names)


def _ceiling_lamps(layout: Layout) -> None:
    """One in the middle, or two of a kind in a long room."""
    w, d, h = layout.size_m
    look = int(layout.rng.integers(1 << 30))
    two = max(w, d) > 4.2 and layout.rng.uniform() < 0.5
    for share in (0.28, 0.72) if two else (0.5,):
        lamp = layout.make("ceiling_lamp", np.random.default_rng(look))
        x, y = (w * share, d / 2) if w >= d else (w / 2, d * share)
        layout.put(lamp, 0.0 if w >= d else np.pi / 2, np.array([x, y, h - 0.001]))


def _place(layout: Layout, name: str) -> None:
    if name in _SETS:
        _SETS[name](layout)
        return
    kind = FURNITURE[name]
    assembly = layout.make(name)
    if name == "corner_counter":
        layout.in_corner(assembly)
    elif kind.place == "centre":
        layout.in_centre(assembly)
    else:
        layout.at_wall(assembly, corner=kind.place == "corner", flush=kind.place == "hang")


def _main_piece(layout: Layout, name: str) -> tuple[Assembly, float, np.ndarray] | None:
    """Stand a piece at a wall, trying specimens of several sizes; the piece with its yaw and position, or None."""
    for _ in range(4):
        piece = layout.make(name)
        pose = layout.at_wall(piece, corner=False, flush=False, tries=40)
        if pose is not None:
            return piece, *pose
    return None


def _bed_set(layout: Layout) -> None:
    """A bed, nightstands at its head, often a rug."""
    rng = layout.rng
    found = _main_piece(layout, "bed")
    if found is None:
        return
    bed, yaw, position = found
    low, high = bed.bounds()
    for side in (-1, 1):
        stand = layout.make("nightstand")
        own_low, own_high = stand.bounds()
        reach = high[0] + 0.06 - own_low[0] if side > 0 else low[0] - 0.06 - own_high[0]
        if rng.uniform() < 0.75:
            layout.put(stand, yaw, position + rotation_z(yaw) @ np.array([reach, 0.0, 0.0]))
    if rng.uniform() < 0.5:
        rug = layout.make("rug")
        layout.on_floor_unchecked(rug, yaw, position + rotation_z(yaw) @ np.array([0.0, 1.2, 0.0]))


def _sofa_set(layout: Layout) -> None:
    """A sofa with a low table before it, often on a rug."""
    rng = layout.rng
    found = _main_piece(layout, "sofa")
    if found is None:
        return
    sofa, yaw, position = found
    front = float(sofa.bounds()[1][1])
    if rng.uniform() < 0.6:
        rug = layout.make("rug")
        layout.on_floor_unchecked(rug, yaw, position + rotation_z(yaw) @ np.array([0.0, front - 0.2, 0.0]))
    if rng.uniform() < 0.85:
        table = layout.make("coffee_table")
        own = np.array([rng.uniform(-0.1, 0.1), front + rng.uniform(0.3, 0.45), 0.0])
        layout.put(table, yaw, position + rotation_z(yaw) @ own, in_keep_free=True)


def _desk_set(layout: Layout) -> None:
    """A desk and a chair drawn up to it."""
    rng = layout.rng
    found = _main_piece(layout, "desk")
    if found is None:
        return
    desk, yaw, position = found
    chair = layout.make(("office_chair", "office_chair", "chair", "shell_chair")[int(rng.integers(4))])
    depth = float(desk.bounds()[1][1])
    own = np.array([rng.uniform(-0.12, 0.12), depth + rng.uniform(0.5, 0.75), 0.0])
    turn = yaw + np.pi + rng.uniform(-0.35, 0.35)
    layout.put(chair, turn, position + rotation_z(yaw) @ own, in_keep_free=True)


def _dining_set(layout: Layout) -> None:
    """A table with chairs of one kind round it."""
    rng = layout.rng
    round_top = rng.uniform() < 0.35
    table = layout.make("round_table" if round_top else "dining_table")
    pose = layout.in_centre(table, tries=60, margin_m=0.55)
    if pose is None:
        return
    yaw, position = pose
    low, high = table.bounds()
    kind = ("chair", "chair", "shell_chair", "shell_chair", "stool")[int(rng.integers(5))]
    seats: list[tuple[float, float, float]] = []  # x, y of the table's edge, and the way the chair faces
    middle_y = float(low[1] + high[1]) / 2
    for x in (-0.25, 0.25) if not round_top else (0.0,):
        across = x * float(high[0] - low[0])
        seats += [(across, float(high[1]), np.pi), (across, float(low[1]), 0.0)]
    seats += [(float(high[0]), middle_y, np.pi / 2), (float(low[0]), middle_y, -np.pi / 2)]
    look = rng.integers(1 << 30)
    for x, y, facing in seats:
        if rng.uniform() < 0.7:
            # One generator seed for all: the chairs of a set are alike.
            chair = layout.make(kind, np.random.default_rng(look))
            _draw_up(layout, chair, yaw, position, x, y, facing)


def _draw_up(
    layout: Layout, chair: Assembly, yaw: float, position: np.ndarray, x: float, y: float, facing: float
) -> None:
    """Put ``chair`` at the table's edge (x, y): its seat a little under the top, or further out."""
    for out in (layout.rng.uniform(0.3, 0.4), layout.rng.uniform(0.5, 0.65)):
        # A chair's own y runs from its back to its front; the front points at the table.
        forward = rotation_z(facing) @ np.array([0.0, 1.0, 0.0])
        own = np.array([x, y, 0.0]) - forward * out
        turn = yaw + facing + layout.rng.uniform(-0.15, 0.15)
        if layout.put(chair, turn, position + rotation_z(yaw) @ own, in_keep_free=True):
            return


def _mat(layout: Layout) -> None:
    """A mat on the bathroom floor."""
    rug = layout.make("rug")
    w, d, _ = layout.size_m
    layout.on_floor_unchecked(rug, 0.0, np.array([w * layout.rng.uniform(0.4, 0.6), d * 0.3, 0.0]))


_SETS: dict[str, Callable[[Layout], None]] = {
    "bed_set": _bed_set,
    "sofa_set": _sofa_set,
    "desk_set": _desk_set,
    "dining_set": _dining_set,
    "mat": _mat,
}
