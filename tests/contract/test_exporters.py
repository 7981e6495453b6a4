"""Exported files: what readers of these formats find in them, read without our own code."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcap.reader
import numpy as np
import pytest
import rerun.chunk

from semantic_mapper.replay.log.format import LogReader
from tests.contract import entry_points as api
from tests.contract.golden import LOG, MAP, plain, read
from tests.contract.runs import Points, flat, read_ply

# The map is a golden file, so that only the last digits of float32 differ: sums of thousands of metres, and six places
# of OBJ. Half a voxel is 0.06 m, a step of a colour 1 / 255.
FLOAT = 2e-5


def observe(folder: Path) -> dict[str, Any]:
    """Structure and numbers of one file a format."""
    return {name: look(folder) for name, look in _LOOKS.items()}


def export(source: Path, out: Path, *more: str) -> Path:
    """The verb, in this process."""
    ran = api.run_here("export", source, "--out", out, *more)
    assert ran.code == 0, ran.stderr
    return out


def statistics(values: np.ndarray) -> dict[str, Any]:
    """Bounds and means of columns."""
    values = values.astype(np.float64)
    return {"least": values.min(0).tolist(), "most": values.max(0).tolist(), "mean": values.mean(0).tolist()}


def describe(points: Points) -> dict[str, Any]:
    """Numbers of vertices."""
    return {
        "xyz": statistics(points.xyz),
        "rgb": points.rgb.mean(0).tolist(),
        "labels": np.bincount(points.label).tolist(),
        "confidence": statistics(points.confidence[:, None]),
    }


def look_at_ply(folder: Path) -> dict[str, Any]:
    """Points, in the colours of their classes."""
    points, header, faces = read_ply(export(MAP, folder / "map.ply"))
    colored, _, _ = read_ply(export(MAP, folder / "class.ply", "--color", "class", "--min-confidence", "0.5"))
    return {"header": header, "faces": faces, "points": describe(points), "class": describe(colored)}


def look_at_ply_mesh(folder: Path) -> dict[str, Any]:
    """A mesh with the same vertices."""
    points, header, faces = read_ply(export(MAP, folder / "mesh.ply", "--format", "ply-mesh"))
    return {"header": header, "faces": faces, "points": describe(points)}


def look_at_glb(folder: Path) -> dict[str, Any]:
    """The JSON of the file, and the bounds that it tells."""
    data = export(MAP, folder / "map.glb", "--up", "z").read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    size, kind = struct.unpack("<I4s", data[12:20])
    scene = json.loads(data[20 : 20 + size])
    accessors = [{k: v for k, v in a.items() if k not in ("min", "max")} for a in scene["accessors"]]
    bounds = [{k: a[k] for k in ("min", "max") if k in a} for a in scene["accessors"]]
    return {
        "head": [magic.decode(), version, kind.decode(), length == len(data)],
        "accessors": accessors,
        "bounds": {str(i): bound for i, bound in enumerate(bounds)},
        "primitives": scene["meshes"][0]["primitives"],
        "nodes": {str(i): flat(node) for i, node in enumerate(scene["nodes"])} if "matrix" in scene["nodes"][0] else {},
        "generator": "generator" in scene["asset"],
        "asset": scene["asset"]["version"],
    }


def look_at_grid(folder: Path) -> dict[str, Any]:
    """A floor plan for map servers."""
    text = export(MAP, folder / "plan.yaml", "--up", "z", "--floor", "0", "--resolution", "0.2").read_text()
    picture = (folder / "plan.pgm").read_bytes()
    values = dict(line.split(": ", 1) for line in text.splitlines())
    _, size, _, grey = picture.split(b"\n", 3)
    cells = np.frombuffer(grey, np.uint8)
    return {
        "keys": sorted(values),
        "fixed": {
            key: values[key] for key in ("image", "mode", "resolution", "negate", "occupied_thresh", "free_thresh")
        },
        "origin": json.loads(values["origin"]),
        "size": size.decode(),
        "cells": {str(v): int((cells == v).sum()) for v in (0, 205, 254)},
    }


def _rerun_rows(path: Path) -> dict[str, int]:
    rows: dict[str, int] = {}
    for chunk in rerun.chunk.RrdReader(path).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return {name: count for name, count in rows.items() if not name.startswith("/__")}


def look_at_rrd(folder: Path) -> dict[str, Any]:
    """Entities of a map's recording, and how often each was logged."""
    return {"map": _rerun_rows(export(MAP, folder / "map.rrd"))}


def look_at_trajectory(folder: Path) -> dict[str, Any]:
    """A TUM trajectory."""
    lines = export(LOG, folder / "poses.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    numbers = np.array([row[1:] for row in rows], np.float64)
    return {"stamps": [row[0] for row in rows], "poses": {str(i): row.tolist() for i, row in enumerate(numbers)}}


def look_at_tum(folder: Path) -> dict[str, Any]:
    """Files of a TUM sequence; PNG bytes may change, images may not."""
    out = export(LOG, folder / "desk", "--format", "tum", "--max-frames", "3")
    files = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    lists = {name: (out / name).read_text().splitlines()[-1] for name in ("rgb.txt", "depth.txt")}
    return {"files": files, "lists": lists}


def look_at_folder(folder: Path) -> dict[str, Any]:
    """Files of a sequence folder, and that it is imported again without loss."""
    out = export(LOG, folder / "sequence", "--max-frames", "3")
    files = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    text = {name: json.loads((out / name).read_text()) for name in ("intrinsics.json", "labels.json")}
    assert api.run_here("import", out, folder / "back.mcap").code == 0
    with LogReader(LOG) as log, LogReader(folder / "back.mcap") as back:
        pairs = list(zip(log, back, strict=False))
        for one, other in pairs:
            for name in ("rgb", "label", "T_world_camera"):
                assert plain(getattr(one, name)) == plain(getattr(other, name))
            assert one.depth_m is not None and other.depth_m is not None
            np.testing.assert_allclose(one.depth_m, other.depth_m, atol=6e-4)  # whole millimetres
    return {"files": files, "text": text, "frames": len(pairs)}


def look_at_foxglove(folder: Path) -> dict[str, Any]:
    """Channels, schemas and messages."""
    with export(LOG, folder / "foxglove.mcap").open("rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True)
        found = [(s, c, m.log_time, json.loads(m.data)) for s, c, m in reader.iter_messages()]
    channels: dict[str, Any] = {}
    for schema, channel, _, message in found:
        assert schema is not None
        entry = channels.setdefault(
            channel.topic, {"schema": schema.name, "encoding": channel.message_encoding, "messages": 0}
        )
        entry["messages"] += 1
        entry["fields"] = sorted(message)
    transforms = [m for _, c, _, m in found if c.topic == "/tf"]
    return {"channels": channels, "stamps": [t for _, c, t, _ in found if c.topic == "/tf"], "tf": flat(transforms[1])}


_LOOKS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "ply": look_at_ply,
    "ply-mesh": look_at_ply_mesh,
    "glb": look_at_glb,
    "grid": look_at_grid,
    "rrd": look_at_rrd,
    "trajectory": look_at_trajectory,
    "tum": look_at_tum,
    "folder": look_at_folder,
    "foxglove": look_at_foxglove,
}
_GOLDEN: dict[str, dict[str, Any]] = read("exporters")


def unlike(then: Any, now: Any, where: str = "") -> list[str]:
    """Differences, floats beyond ``FLOAT`` (relative to numbers above 1); keys that came since are welcome."""
    if isinstance(then, dict) and isinstance(now, dict):
        missing = [f"{where}.{key}: is missing" for key in then if key not in now]
        return missing + [line for key in then if key in now for line in unlike(then[key], now[key], f"{where}.{key}")]
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        return [line for i, pair in enumerate(zip(then, now, strict=True)) for line in unlike(*pair, f"{where}[{i}]")]
    if isinstance(then, float) and isinstance(now, int | float):
        return [] if abs(then - now) <= FLOAT * max(1, abs(then)) else [f"{where}: was {then}, is {now}"]
    return [] if then == now else [f"{where}: was {then!r}, is {now!r}"]


@pytest.mark.parametrize("name", _GOLDEN)
def test_an_exported_file_is_what_it_was(name: str, tmp_path: Path) -> None:
    now = _LOOKS[name](tmp_path)
    assert unlike(_GOLDEN[name], now) == []
