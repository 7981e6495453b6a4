"""Class names, ids and colours. A class id means something only together with its ``LabelSet``.

Images and maps hold *ids* (uint8, the numbers of the data set, ``ignore_id`` = unknown). Networks and evidence tables
hold *channels*: the position of an id in ``LabelSet.ids``. Only this module converts between the two.
"""

import colorsys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import nearest
from semantic_mapper.errors import LabelError
from semantic_mapper.types import UInt8

IGNORE_CHANNEL = -1
MAX_NAME = 128  # letters of a name, as in headers of messages (transport/messages.py)


@dataclass(frozen=True, slots=True)
class LabelSet:
    """An ordered set of classes."""

    name: str  # of the set ("nyu40", "rooms", ...)
    ids: tuple[int, ...]  # class ids as they stand in label images, in channel order; ``ignore_id`` is not among them
    names: tuple[str, ...]  # one name a class
    # one (r, g, b) a class, 0 to 255; for the eye only, sets that differ in nothing else are equal
    colors: tuple[tuple[int, int, int], ...] = field(compare=False)
    ignore_id: int = 0  # the id that means "unknown, do not count"

    def __post_init__(self) -> None:
        longest = max((self.name, *self.names), key=len)
        troubles = (
            (not len(self.ids) == len(self.names) == len(self.colors), "ids, names and colors: one entry a class"),
            (not self.ids, "has no classes"),
            (len(set(self.ids)) != len(self.ids) or len(set(self.names)) != len(self.names), "has a class twice"),
            (len(longest) > MAX_NAME, f"{longest[:MAX_NAME]}... has {len(longest):,} letters, and may have {MAX_NAME}"),
            (
                self.ignore_id is None or self.ignore_id in self.ids,
                f"needs an ignore id that is no class, got {self.ignore_id}; make_label_set(ignore_id=None) finds one",
            ),
            (not all(0 <= i <= 255 for i in (*self.ids, self.ignore_id or 0)), "ids must lie in 0..255"),
        )
        for wrong, what in troubles:
            if wrong:
                raise LabelError(f"label set '{self.name[:MAX_NAME]}': {what}")

    def __len__(self) -> int:
        return len(self.ids)

    def to_channels(self, label: UInt8, where: str = "label image") -> NDArray[np.int64]:
        """Ids -> channels, any shape; the ignore id becomes -1. Raises LabelError: where an id is not in the set."""
        table = np.full(256, IGNORE_CHANNEL - 1, np.int64)
        table[list(self.ids)] = np.arange(len(self.ids))
        table[self.ignore_id] = IGNORE_CHANNEL
        channels = table[label]
        if channels.size and int(channels.min()) < IGNORE_CHANNEL:
            unknown = sorted(int(i) for i in np.unique(label[channels < IGNORE_CHANNEL]))
            raise LabelError(
                f"{where}: class ids {unknown} are not in label set '{self.name}' (ids {list(self.ids)}, "
                f"ignore {self.ignore_id}); add them to labels.json or map them to the ignore id"
            )
        return channels

    def to_ids(self, channels: NDArray[np.int64]) -> UInt8:
        """Channels -> ids, any shape; -1 becomes the ignore id."""
        table = np.array((*self.ids, self.ignore_id), np.uint8)
        return table[channels]

    def colorize(self, label: UInt8) -> UInt8:
        """Ids (...) -> colours (..., 3) uint8; the ignore id and foreign ids are black."""
        table = np.zeros((256, 3), np.uint8)
        table[list(self.ids)] = np.array(self.colors, np.uint8)
        return table[label]

    def id_of(self, name: str) -> int:
        """Id of a class. Raises LabelError: no class of that name; says the nearest one, and all."""
        if name not in self.names:
            hint = nearest(name, self.names)
            rest = f" It has {', '.join(self.names)}" if hint.endswith("?") else ""
            raise LabelError(f"label set '{self.name}' has no class '{name}'{hint}{rest}")
        return self.ids[self.names.index(name)]

    def thing_ids(self, stuff: Collection[str]) -> tuple[int, ...]:
        """Ids of the classes that come in countable pieces: all but those named in ``stuff`` (see ``STUFF_NAMES``)."""
        return tuple(i for i, name in zip(self.ids, self.names, strict=True) if name not in stuff)

    def renamed(self, names: Mapping[str, str]) -> "tuple[LabelSet, UInt8]":
        """Give classes other names, by the present ones; those that then have one name become one, of the lowest id.

        Raises LabelError: a present name that is not in the set.

        Returns:
            The new set, and its id for each id 0..255 of this one (ids that this set lacks stay as they are).
        """
        unknown = sorted(set(names) - set(self.names))
        if unknown:
            raise LabelError(f"label set '{self.name}' has no classes {unknown} to rename; it has {sorted(self.names)}")
        table = np.arange(256, dtype=np.uint8)
        first: dict[str, tuple[int, tuple[int, int, int]]] = {}
        for old_id, old_name, color in sorted(zip(self.ids, self.names, self.colors, strict=True)):
            new_id, _ = first.setdefault(names.get(old_name, old_name), (old_id, color))
            table[old_id] = new_id
        ids, colors = zip(*first.values(), strict=True)
        return LabelSet(self.name, ids, tuple(first), colors, self.ignore_id), table

    def with_names(self, names: Sequence[str]) -> "LabelSet":
        """This set and classes of more names, in their order, with the lowest ids that are free.

        Raises LabelError: there are no more ids, or a name is there already.
        """
        free = [i for i in range(256) if i not in self.ids and i != self.ignore_id][: len(names)]
        if len(free) < len(names):
            raise LabelError(f"label set '{self.name}' has {len(self)} classes, and no ids for {len(names)} others")
        colors = self.colors + tuple(_distinct_color(i) for i in free)
        return LabelSet(self.name, (*self.ids, *free), (*self.names, *names), colors, self.ignore_id)

    def channel_map_from(self, other: "LabelSet") -> NDArray[np.int64]:
        """For each id 0..255 of ``other``: this set's channel of the class with the same name, else -1."""
        mine = {name: channel for channel, name in enumerate(self.names)}
        table = np.full(256, IGNORE_CHANNEL, np.int64)
        for other_id, name in zip(other.ids, other.names, strict=True):
            table[other_id] = mine.get(name, IGNORE_CHANNEL)
        return table


def make_label_set(
    name: str, names: Sequence[str], *, ids: Sequence[int] | None = None, ignore_id: int | None = 0
) -> LabelSet:
    """Build a label set with distinct generated colours.

    Without ids the classes are 1, 2, 3, ... The ignore id means unknown; None, for a data set that has none, stands for
    the highest id that is no class. Raises LabelError: names or ids that are no label set, or all 256 ids are classes,
    so that none can mean unknown.
    """
    chosen = tuple(ids) if ids is not None else tuple(range(1, len(names) + 1))
    if ignore_id is None:
        ignore_id = next((i for i in range(255, -1, -1) if i not in chosen), None)
    if ignore_id is None:
        raise LabelError(f"label set '{name}': all 256 ids are classes; one must be left to mean unknown")
    return LabelSet(name, chosen, tuple(names), tuple(_distinct_color(i) for i in chosen), ignore_id)


# Each colour is the one farthest in CIELAB from those before it, from black and from grey; dull ones and neon left out.
_PALETTE = (
    "9bbfe3 e3801d 38b64a fe53a4 5c4abf 14f5e3 ece353 65652f f5ada4 b61426 ecadfe 147765 "
    "b6d1a4 804a6e 2f5c92 895341 fed192 a4269b 809bfe 14adbf 809b1d 1dfead b6f577 266e26 "
    "b69214 c89bb6 c85c6e 1d6577 fe775c 53bf92 ad926e a4ecec 895c14 14adfe 926eb6 fe77e3 "
    "b680fe a42665 ad4a14 e3d1fe 6e926e bfbf6e fe92b6 a4f5ad ec9b6e 1465c8 c865a4 9292bf"
).split()


def _distinct_color(index: int) -> tuple[int, int, int]:
    """Colours that the eye tells apart for ids 1 to 48; golden-angle hues beyond."""
    if 1 <= index <= len(_PALETTE):
        r, g, b = bytes.fromhex(_PALETTE[index - 1])
        return r, g, b
    hue = (index * 0.6180339887) % 1.0
    r, g, b = (round(255 * c) for c in colorsys.hsv_to_rgb(hue, 0.65, (0.95, 0.7)[index % 2]))
    return r, g, b


_NYU40 = (
    "wall floor cabinet bed chair sofa table door window bookshelf picture counter blinds desk shelves curtain "
    "dresser pillow mirror floormat clothes ceiling books refrigerator television paper towel showercurtain box "
    "whiteboard person nightstand toilet sink lamp bathtub bag otherstructure otherfurniture otherprop"
).split()
_SCANNET20_IDS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36, 39)
_ROOMS = (
    "wall floor ceiling cabinet bed chair sofa table door window bookshelf picture counter desk curtain refrigerator "
    "toilet sink bathtub otherfurniture otherprop person"
).split()
_CAMVID11 = "sky building pole road pavement tree signsymbol fence car pedestrian bicyclist".split()
_KITTI360 = (
    "road sidewalk parking terrain building wall fence gate vegetation car trailer caravan box sky pole sign"
).split()
_CARLA = (
    "roads sidewalks building wall fence pole trafficlight trafficsign vegetation terrain pedestrian car truck bus "
    "static dynamic water roadline ground bridge"
).split()
_KLEVR = "background cube cylinder sphere torus gear".split()

NYU40 = make_label_set("nyu40", _NYU40)
SCANNET20 = make_label_set("scannet20", [_NYU40[i - 1] for i in _SCANNET20_IDS], ids=_SCANNET20_IDS)
ROOMS = make_label_set("rooms", _ROOMS)
CAMVID11 = make_label_set("camvid11", _CAMVID11)
KITTI360 = make_label_set("kitti360", _KITTI360)
CARLA = make_label_set("carla", _CARLA)
KLEVR = make_label_set("klevr", _KLEVR)

PROVIDED = {s.name: s for s in (NYU40, SCANNET20, ROOMS, CAMVID11, KITTI360, CARLA, KLEVR)}

# Classes of the provided sets that are surfaces or masses, not countable things.
STUFF_NAMES = frozenset(
    "wall floor ceiling floormat otherstructure sky building road roads roadline pavement sidewalk sidewalks parking "
    "terrain vegetation tree fence ground water bridge static background".split()
)
# What people call classes whose names do not say it.
PLAIN_NAMES = {"otherprop": "other object", "otherfurniture": "other furniture", "otherstructure": "other structure"}
# Classes of things that move by themselves. Vehicles are not among them: most that a camera meets are parked.
MOVING_NAMES = frozenset("person people human pedestrian rider bicyclist cyclist motorcyclist animal dog cat".split())
