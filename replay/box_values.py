"""What files of boxes hold, and the checks of their values: each error says what is wrong with one box."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive, centred
from semantic_mapper.geometry import MAX_TRANSLATION_M, check_pose
from semantic_mapper.labels import STUFF_NAMES
from semantic_mapper.types import Float64, Int64

MAX_ID = 65535  # what an instance image of 16 bits holds; 0 is none
MIN_SIZE_M = 0.001
MAX_TIME = 2**63 - 1
# A box is one thing unless its class is one of these. As KITTI-360 has it, a building is a thing, too.
BOX_STUFF = STUFF_NAMES - {"building"} | {"rail track", "guard rail", "tunnel", "gate", "polegroup"}


@dataclass(frozen=True, slots=True)
class BadBox:
    """A box that cannot be used: its place in the file from 1, its id where it has one, and what is wrong."""

    number: int
    id: int | None
    problem: str

    def __str__(self) -> str:
        return f"box {self.number}{'' if self.id is None else f' (id {self.id})'}: {self.problem}"


@dataclass(frozen=True, slots=True)
class BoxFile:
    """What a file of boxes says.

    Args:
        primitives: In the order of the file, those that move among them.
        merge: By class of the pseudo labels: classes that they cannot tell from it.
        left_out: How many boxes of the file are of no class at all (KITTI-360's "unknown").
        bad: Boxes that cannot be used.
        is_xml: Whether it is one of KITTI-360.
    """

    primitives: tuple[Primitive, ...]
    merge: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    left_out: int = 0
    bad: tuple[BadBox, ...] = ()
    is_xml: bool = False


def is_thing(class_name: str) -> bool:
    """Whether boxes of a class are things where nothing says so."""
    return class_name not in BOX_STUFF


def each_once(
    good: Iterable[tuple[int, Primitive]], bad: Iterable[BadBox]
) -> tuple[tuple[Primitive, ...], tuple[BadBox, ...]]:
    """Boxes, each with its number in the file, and bad ones: those with the id of an earlier one are bad, too."""
    seen: dict[int, int] = {}
    kept: list[Primitive] = []
    more = list(bad)
    for number, box in good:
        first = seen.setdefault(box.id, number)
        if first == number:
            kept.append(box)
        else:
            more.append(BadBox(number, box.id, f"id {box.id} is that of box {first}; give it another"))
    return tuple(kept), tuple(sorted(more, key=lambda b: b.number))


def numbers(value: Any, name: str, shape: tuple[int | None, ...], most: float = np.inf) -> Float64:
    """Finite numbers of a shape, None = any length, none larger than ``most``.

    Raises:
        ConfigError: they are not.
    """
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{name} must be numbers: {error}") from error
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("N" if n is None else str(n) for n in shape)
        raise ConfigError(f"{name} must be {wanted} numbers, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} holds NaN or infinity")
    if array.size and np.abs(array).max() > most:
        raise ConfigError(f"{name} must be metres within {most / 1000:g} km, got {float(np.abs(array).max()):g} m")
    return array


def metres(value: Any, name: str, shape: tuple[int | None, ...]) -> Float64:
    """Lengths or places of a shape.

    Raises:
        ConfigError: they are none.
    """
    return numbers(value, name, shape, MAX_TRANSLATION_M)


def box_of(size: Float64, **rest: Any) -> Primitive:
    """A primitive whose outline or mesh is one, with the origin of its axes in its middle.

    Raises:
        ConfigError: it is thin, open, or crosses itself.
    """
    if not (size >= MIN_SIZE_M).all():
        raise ConfigError(f"size must be at least {MIN_SIZE_M} m along all axes, got {size.tolist()}")
    box = centred(Primitive(size=size, **rest))
    box.mesh()
    return box


def outline(value: Any) -> Float64:
    """Corners (N, 2) of a polygon, without those that repeat the one before, as the last of a closed ring does.

    Raises:
        ConfigError: fewer than three are left.
    """
    polygon = metres(value, "polygon", (None, 2))
    polygon = polygon[(polygon != np.roll(polygon, 1, axis=0)).any(axis=1)]
    if len(polygon) < 3:
        raise ConfigError(f"polygon must have at least 3 different corners, got {len(polygon)}")
    return polygon


def whole_faces(value: Any, corners: int | None = 3) -> Int64:
    """Numbers (F, corners) of the vertices of faces.

    Raises:
        ConfigError: fractions, or below 0.
    """
    array = numbers(value, "faces", (None, corners))
    if (array != np.round(array)).any() or (array < 0).any() or (array > MAX_TIME / 2).any():
        raise ConfigError("faces must be whole numbers: those of the vertices of each, from 0")
    return array.astype(np.int64)


def pose_of(value: Any, name: str = "T_world_box") -> Float64:
    """A rigid pose (4, 4) of a box.

    Raises:
        ConfigError, PoseError: it is none.
    """
    pose = numbers(value, name, (4, 4))
    check_pose(pose, name, "box")
    return pose


def poses_by(value: Any, key: str, unit: str) -> tuple[tuple[int, Float64], ...]:
    """Poses of one that moves, by ascending time or number of the frame.

    Raises:
        ConfigError, PoseError: what cannot be used.
    """
    if not isinstance(value, list) or not value or not all(isinstance(s, list) and len(s) == 2 for s in value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        raise ConfigError(f"{key} must be [[{unit}, 4x4 pose], ...]")
    known: dict[int, Float64] = {}
    for when, pose in cast("list[list[Any]]", value):
        if not isinstance(when, int) or isinstance(when, bool) or not 0 <= when <= MAX_TIME:
            raise ConfigError(f"{key} must be whole numbers of {unit} from 0, got {when!r:.40}")
        if when in known:
            raise ConfigError(f"{key} has {when} twice; give each once")
        known[when] = pose_of(pose, f"{key}, pose at {when}")
    return tuple(sorted(known.items()))


def whole_id(value: Any) -> int:
    """The id of a box.

    Raises:
        ConfigError: no whole number in its range.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MAX_ID:
        raise ConfigError(f"id must be a whole number from 1 to {MAX_ID}, got {value!r:.40}")
    return value


def class_of(value: Any) -> str:
    """The name of a class.

    Raises:
        ConfigError: no text, or an empty one.
    """
    if not isinstance(value, str) or not value.strip():
        raise ConfigError(f"class must be the name of a class, got {value!r:.40}")
    return value
