"""A saved map for other programs: one file format each, chosen by the name of the file or by hand."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import read_toml
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.files import atomic_path
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.floor_plan import FREE, OCCUPIED, UNKNOWN, find_up, occupancy_grid, write_map_server
from semantic_mapper.mapping.formats import ColorBy, colored, sure_faces, sure_points, write_glb, write_ply
from semantic_mapper.mapping.fusion import SURFACE_WEIGHT
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.graph import find_graph
from semantic_mapper.replay.exporters.base import choose_format
from semantic_mapper.replay.run_folder import MAP_SUFFIX
from semantic_mapper.types import Float64

Format = Literal["ply", "ply-mesh", "glb", "grid", "rrd"]
SUFFIXES: dict[str, Format] = {".ply": "ply", ".glb": "glb", ".pgm": "grid", ".yaml": "grid", ".rrd": "rrd"}
FORMATS: tuple[Format, ...] = get_args(Format)
# Formats that an option is for, besides min_weight and min_confidence.
_OPTIONS: dict[str, tuple[Format, ...]] = {
    "color": ("ply", "ply-mesh", "glb"),
    "up": ("glb", "grid"),
    **dict.fromkeys(("height", "resolution", "floor", "costs"), ("grid",)),
}
AXES = {sign + name: s * np.eye(3)[i] for sign, s in (("", 1.0), ("-", -1.0)) for i, name in enumerate("xyz")}


@dataclass(frozen=True, slots=True, eq=False)
class ExportRequest:
    """What to write; None = the default, and not requested."""

    format: Format  # of the file
    min_weight: float = SURFACE_WEIGHT  # voxels of less weight are left out; 1 = only measured surface
    min_confidence: float = 0.0  # surface whose label is less sure is left out; 0 keeps what nothing voted for, too
    color: ColorBy | None = None  # points and meshes: what the colours show; the camera's by default
    # GLB and grid: (3,) unit vector, up in the world; found by ``find_up`` by default, or refused
    up: Float64 | None = None
    height: tuple[float, float] | None = None  # grid: LOW and HIGH in metres above the floor
    resolution: float | None = None  # grid: side of a cell in metres; 5 cm by default, or a voxel where that is larger
    floor: float | None = None  # grid: height of the floor along ``up`` in metres; found by default
    # grid: TOML file with the cost of classes; a grid of costs is written next to the plan then
    costs: Path | None = None


@dataclass(frozen=True, slots=True)
class ExportReport:
    """What was written: the files, what is in them, and what had to be found out for it."""

    files: tuple[Path, ...]
    content: str
    found: tuple[str, ...] = ()


def format_of(path: Path, given: str | None) -> Format:
    """See ``choose_format``; .npz alone is refused, since saved maps end so."""
    if given is None and path.suffix.lower() == MAP_SUFFIX:
        raise ConfigError(
            f"{path}: so end saved maps, which the mapper writes (a running one at its end, and by save_every_s); "
            ".ply has its points, with label and confidence"
        )
    return choose_format(path, given, SUFFIXES, FORMATS)


def parse_up(text: str) -> Float64 | None:
    """``auto`` (None), an axis of the world (x, -y, ...), or three numbers. Raises ConfigError: none of these."""
    if text == "auto":
        return None
    direction = AXES[text] if text in AXES else parse_numbers(text)
    if direction is None or direction.shape != (3,) or not direction.any():
        raise ConfigError(f"--up {text}: give auto, one of {' '.join(AXES)}, or three numbers such as '0 -1 0.2'")
    return direction / np.linalg.norm(direction)


def parse_numbers(text: str) -> Float64 | None:
    """Finite numbers, with spaces or commas between them; None where it is something else."""
    try:
        numbers = np.array(text.replace(",", " ").split(), np.float64)
    except ValueError:
        return None
    return numbers if np.isfinite(numbers).all() else None


def export_map(voxel_map: VoxelMap, path: Path, request: ExportRequest) -> ExportReport:
    """Write a map to ``path``, and what belongs to it next to it.

    Raises ConfigError: an option that the format cannot honour. MapError: nothing to write, a floor plan of a map
    without metres, impossible numbers, or the file cannot be written.
    """
    for option, able in _OPTIONS.items():
        if getattr(request, option) is not None and request.format not in able:
            raise ConfigError(f"--{option} means nothing for format {request.format}; it is for {', '.join(able)}")
    if request.format == "grid":
        require_metres(voxel_map.scale_known, f"{path}: a floor plan")
        return _export_grid(voxel_map, path, request)
    write = _export_mesh if request.format in ("ply-mesh", "glb") else _export_points
    report = write(voxel_map, path, request)
    if voxel_map.scale_known:
        return report
    return replace(report, found=(*report.found, "scale: unknown; lengths are not metres"))


def _export_points(voxel_map: VoxelMap, path: Path, request: ExportRequest) -> ExportReport:
    labels = voxel_map.label_set
    points = sure_points(voxel_map.points(request.min_weight), request.min_confidence)
    if request.format == "ply":
        write_ply(path, colored(points, labels, request.color or "rgb"), labels, scale_known=voxel_map.scale_known)
    else:
        with atomic_path(path, raises=MapError) as part:
            from semantic_mapper.replay.rerun_log import RerunLog, recording_file

            log = RerunLog(recording_file(part), labels, voxel_map.config.voxel_size_m)
            log.note_scale(voxel_map.scale_known)
            log.finish(points, find_graph(voxel_map))
    return ExportReport((path,), f"{len(points.xyz):,} points")


def _export_mesh(voxel_map: VoxelMap, path: Path, request: ExportRequest) -> ExportReport:
    labels, scale_known = voxel_map.label_set, voxel_map.scale_known
    mesh = sure_faces(voxel_map.mesh(request.min_weight), request.min_confidence)
    if not len(mesh.faces):
        raise MapError("the map has no surface to mesh, or none that is measured so often and so sure")
    color = request.color or "rgb"
    mesh, found = colored(mesh, labels, color), ()
    if request.format == "ply-mesh":
        write_ply(path, mesh, labels, scale_known=scale_known)
    else:
        up = request.up if request.up is not None else find_up(voxel_map.points(request.min_weight), labels)
        write_glb(path, mesh, up, scale_known=scale_known)
        found = _found_up(request, up)
    return ExportReport((path,), f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces", found)


def _export_grid(voxel_map: VoxelMap, path: Path, request: ExportRequest) -> ExportReport:
    voxel = voxel_map.config.voxel_size_m
    cost_of = None if request.costs is None else read_costs(request.costs, voxel_map.label_set)
    points = voxel_map.points(request.min_weight)
    up = request.up if request.up is not None else find_up(points, voxel_map.label_set)
    points = sure_points(points, request.min_confidence)
    grid = occupancy_grid(points, up, voxel, request.height, request.floor, cost_of, request.resolution)
    files = write_map_server(path, grid)
    area = {name: (grid.cells == value).sum() * grid.resolution_m**2 for name, value in _STATES.items()}
    content = f"{grid.cells.shape[1]} x {grid.cells.shape[0]} cells of {grid.resolution_m:g} m: " + ", ".join(
        f"{square:.1f} m2 {name}" for name, square in area.items()
    )
    level = round(-float(grid.T_grid_world[2, 3]), 2) + 0.0  # never -0
    floor = () if request.floor is not None else (f"floor at {level:.2f} m (--floor sets it)",)
    return ExportReport(files, content, _found_up(request, up) + floor)


def read_costs(path: Path, label_set: LabelSet) -> NDArray[np.int64]:
    """Cost (256,) of each class id, -1 where a TOML file of lines ``CLASS = COST`` has none; ``unknown`` is one, too.

    Raises ConfigError: no such file, no TOML, no class of the map, or no cost.
    """
    ids = dict(zip((*label_set.names, "unknown"), (*label_set.ids, label_set.ignore_id), strict=True))
    costs = np.full(256, -1, np.int64)
    given = read_toml(path)
    if not given:
        raise ConfigError(f"{path}: has no costs; write lines CLASS = COST, from 0 to 100")
    for name, value in given.items():
        if name not in ids or type(value) is not int or not 0 <= value <= OCCUPIED:
            raise ConfigError(
                f"{path}: {name} = {value!r}: a cost is a whole number from 0, free, to 100, no way through, of one of "
                f"the classes {', '.join(sorted(ids))}"
            )
        costs[ids[name]] = value
    return costs


_STATES = {"free": FREE, "occupied": OCCUPIED, "unknown": UNKNOWN}


def _found_up(request: ExportRequest, up: Float64) -> tuple[str, ...]:
    if request.up is not None:
        return ()
    name = next((name for name, axis in AXES.items() if (axis == up).all()), " ".join(f"{c:.3f}" for c in up))
    return (f"up is {name} (--up sets it)",)
