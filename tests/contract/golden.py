"""Where golden data lies, and how values are written down and compared."""

import dataclasses
import enum
import hashlib
import json
import re
from base64 import b64decode
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

REPOSITORY = Path(__file__).parents[2]
FOLDER = Path(__file__).parent / "golden"
LOG = FOLDER / "room.mcap"
WEIGHTS = FOLDER / "small.safetensors"
STORED = FOLDER / "stored"  # a run as `pytest --update-runs` stores it: map.npz (uint16 evidence) and summary.json
MAP = STORED / "map.npz"
MAP_COARSE = FOLDER / "map-coarse.npz"
POINTS = FOLDER / "points.npz"  # surface of the map of ROOM_SETTINGS
FRAMES = 11  # of the log
REFUSED_SEQ = 5  # the one whose pose is no rotation
# Half of the frames' size is that of the feature maps, so that rays meet the middles of their pixels. At a quarter they
# would meet the very borders between two, and rounding would say which of the two the current view looks up.
ROOM_SETTINGS = "[render]\nscale = 0.5\n[voxel_map]\nvoxel_size_m = 0.05\nunknown_below = 0.0\n"
STORED_SETTINGS = {  # of a time when frames told the map what was rendered, and nothing else
    "render": {"scale": 0.5},
    "keyframes": {"own_image_weight": 0.0},
    "voxel_map": {"voxel_size_m": 0.12, "unknown_below": 0.0},
}
STORED_FRAMES = 3
SMALL_ARRAY = 16  # numbers that are written down one by one; of larger arrays the digest


def read(name: str) -> Any:
    """Golden values of a group; nothing where it is being recorded for the first time, see ``test_golden``."""
    path = FOLDER / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else defaultdict(dict)


def write(name: str, values: Any) -> None:
    """Store golden values, one to a line where they are lists of objects."""
    text = json.dumps(values, indent=1, sort_keys=True, ensure_ascii=False)
    (FOLDER / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def digest(data: bytes) -> str:
    """Enough of SHA-256 to tell two values apart."""
    return hashlib.sha256(data).hexdigest()[:32]


def plain(value: Any) -> Any:
    """Any value as JSON, floats with all their digits; of large arrays and files the digest."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        shown = {"dtype": array.dtype.name, "shape": list(array.shape)}
        numbers = array.ravel().tolist()
        if array.size <= SMALL_ARRAY and np.isfinite(array).all():
            return {**shown, "values": numbers}
        return {**shown, "digest": digest(array.tobytes())}
    if isinstance(value, bytes | bytearray | memoryview):
        return {"bytes": len(value), "digest": digest(bytes(value))}
    if isinstance(value, enum.Enum):
        return plain(value.value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, msgspec.Struct):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    if dataclasses.is_dataclass(value):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return value.name
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [plain(item) for item in value]
    return value


def leaves(value: Any) -> dict[str, list[str]]:
    """All values of a structure, whatever their fields are called: these may get other names in Python."""
    found: list[str] = []
    left = [plain(value)]
    while left:
        item = left.pop()
        if isinstance(item, Mapping):
            left += item.values()
        elif isinstance(item, list):
            left += item
        else:
            found.append(json.dumps(item))
    return {"leaves": sorted(found)}


def parts_of(texts: Sequence[str]) -> list[bytes]:
    """Base 64 -> parts of a message."""
    return [b64decode(text) for text in texts]


def meaning(header: Any) -> dict[str, Any]:
    """A header as ``plain`` has it, but for the number of the protocol's version, and sizes of buffers."""
    return {key: item for key, item in plain(header).items() if key not in ("v", "arrays")}


def form(value: Any) -> Any:
    """Keys and types of JSON data: what a program that reads it relies on. A list has the form of its first item."""
    if isinstance(value, Mapping):
        return {key: form(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [form(item) for item in value[:1]]
    return type(value).__name__


def undocumented(verb: str, found: Any) -> list[str]:
    """Fields of the form of a verb's JSON that docs/json.md has not, or with another type."""
    page = (REPOSITORY / "docs" / "json.md").read_text(encoding="utf-8")
    section = page.partition(f"\n## {verb}\n")[2].partition("\n## ")[0]
    rows = [re.split(r" {2,}", line) for line in section.splitlines() if "  " in line]
    kinds = [(re.escape(name).replace("NAME", ".+"), row[1]) for row in rows for name in row[0].split(", ")]

    tables = [name for name, of in kinds if "table" in of]
    return [
        f"{place}: {kind}"
        for place, kind in _leaves(found)
        if not any(re.fullmatch(name, place) and kind in of for name, of in kinds)
        and not any(re.match(rf"{name}[.[]", f"{place}.") for name in tables)
    ]


def _leaves(value: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """Places of a form, and what is there as docs/json.md calls it; nothing of an empty list."""
    inner = value.items() if isinstance(value, dict) else [("[]", item) for item in value]
    for name, item in inner:
        at = f"{place}.{name}".lstrip(".").replace(".[]", "[]")
        if isinstance(item, str):
            found = {"str": "text", "float": "number", "NoneType": "null"}.get(item, item)
            yield at.rstrip("[]"), f"{'[' * at.count('[]', len(at.rstrip('[]')))}{found}"
        else:
            yield from _leaves(item, at)


def lacking(then: Any, now: Any, where: str = "") -> list[str]:
    """What ``then`` (a form) has and ``now`` lacks or has otherwise; keys that came since are welcome."""
    if "NoneType" in (then, now):  # what may be null, as a room before a floor is known; its type is decoded elsewhere
        return []
    if isinstance(then, Mapping):
        if not isinstance(now, Mapping):
            return [f"{where or 'all'}: was a table, is {now}"]
        missing = [f"{where}.{key}" for key in then if key not in now]
        return missing + [line for key in then if key in now for line in lacking(then[key], now[key], f"{where}.{key}")]
    if isinstance(then, list):
        if not isinstance(now, list):
            return [f"{where}: was a list, is {now}"]
        return lacking(then[0], now[0], f"{where}[]") if then and now else []
    return [] if then == now else [f"{where}: was {then}, is {now}"]


def differences(then: Any, now: Any, where: str = "") -> list[str]:
    """Values of ``then`` that ``now`` lacks or has otherwise, to the last digit; keys that came since are welcome."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        if "leaves" in then:
            return [f"{where}: has no {leaf} any more" for leaf in Counter(then["leaves"]) - Counter(now["leaves"])]
        return [line for key in then for line in differences(then[key], now.get(key, "<missing>"), f"{where}.{key}")]
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        return [
            line for i, pair in enumerate(zip(then, now, strict=True)) for line in differences(*pair, f"{where}[{i}]")
        ]
    return [] if then == now and type(then) is type(now) else [f"{where}: was {then!r}, is {now!r}"]


def fraction(mask: Sequence[bool] | np.ndarray) -> float:
    """Of true values."""
    return float(np.mean(mask))
