"""A map gets metres afterwards: a length that is known scales the poses of its log, which is then mapped again."""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.bundle.scale import find_floor
from semantic_mapper.config import MapperConfig, convert_config
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.artifacts import clear_results
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.format import atomic_log
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.map_log import replay_log
from semantic_mapper.replay.run_folder import LOG_SUFFIX, MAP_NAME, hold_folder, map_path
from semantic_mapper.replay.sfm.scale import FLOOR_KEY, describe_floor, scale_by_floor, scene_depth
from semantic_mapper.replay.summary import SUMMARY_FILE, dig, read_summary
from semantic_mapper.transport.codec import scaled_frame
from semantic_mapper.transport.messages import SCALE_KEY, SCENE_DEPTH_KEY
from semantic_mapper.types import Float64

_NEAR = 0.1  # of the map's extent: a given point lies no farther from its surface
_FLOOR_CONE_DEG = 5.0  # how far up may be off z


@dataclass(frozen=True, slots=True)
class RescaleReport:
    """What has changed."""

    factor: float  # metres in a unit of before
    scale: str  # how it is found
    summary: dict[str, Any]  # of the new map; where its `stopped_by` says something, all is as it was


def rescale_run(
    run: Path,
    metres: float,
    points: tuple[Float64, Float64] | None = None,
    weights: Path | None = None,
    monitor: JobMonitor | None = None,
) -> RescaleReport:
    """Scale the log of a folder of results, and map it again with the settings that its summary has.

    Log and results are replaced once the new ones are whole; after a stop request all stays. ``metres`` are those
    between two ``points`` of the map, (3,) each, or from the floor to the camera (median). ``weights`` None = those of
    before. Raises ConfigError: no log or summary, or one that cannot be scaled. MapError, ImportSourceError: the
    length is not in the map. LogError, WeightsError: they cannot be read or mapped.
    """
    path = map_path(run)
    folder = path.parent
    if path.name != MAP_NAME:
        raise ConfigError(f"{path}: is alone; give the folder of `map`, with {MAP_NAME}, {SUMMARY_FILE} and the log")
    log, summary = _find_log(folder), read_summary(folder)
    with (
        hold_folder(folder),
        LogReader(log) as reader,
        tempfile.TemporaryDirectory(prefix=".scale-", dir=folder) as work,
    ):
        positions = _positions(reader, summary)
        xyz = VoxelMap.load(path).points().xyz.astype(np.float64)
        factor, scale = _factor(metres, points, xyz, positions, reader.info.metadata.get(FLOOR_KEY, ""))
        config = convert_config(summary["config"], MapperConfig, str(folder / SUMMARY_FILE))
        name = Path(str(dig(summary, "weights.file")))
        if weights is None and name.name != default_checkpoint_path().name:
            raise ConfigError(f"{folder}: was mapped with {name}; name the file with --weights")
        old = reader.info.metadata
        depth = scene_depth(factor * float(old[SCENE_DEPTH_KEY])) if SCENE_DEPTH_KEY in old else {}
        info = msgspec.structs.replace(reader.info, metadata={**old, SCALE_KEY: scale, **depth})
        scaled, made = Path(work, log.name), Path(work, "map")
        with atomic_log(scaled, info, attachments=tuple(reader.attachments().values())) as writer:
            for _, parts in reader.frame_parts():
                writer.write_parts(scaled_frame(parts, factor))
        count = 0 if summary.get("stopped_by") else int(dig(summary, "frames.published") or 0)
        new, _ = replay_log(scaled, made, weights, config, count, monitor=monitor)
        if not new["stopped_by"]:
            clear_results(folder)
            os.replace(scaled, folder / log.name)
            for file in sorted(made.iterdir(), key=lambda file: file.name == SUMMARY_FILE):  # that of a whole result
                os.replace(file, folder / file.name)
    return RescaleReport(factor, scale, new)


def _find_log(folder: Path) -> Path:
    logs = sorted(folder.glob(f"*{LOG_SUFFIX}"))
    if len(logs) != 1:
        raise ConfigError(
            f"{folder}: holds {counted(len(logs), 'log')} (*{LOG_SUFFIX}); voxels and classes depend on metres, so "
            "that a map is scaled by mapping its log again: put the one that it was made of there"
        )
    return logs[0]


def _positions(reader: LogReader, summary: dict[str, Any]) -> Float64:
    """Of the cameras (N, 3) of a log that the map was made of, and whose poses alone have a scale."""
    path, envelopes = reader.path, [envelope for envelope, _ in reader.frame_parts()]
    if summary.get("source") != reader.info.source:
        raise ConfigError(f"{path}: is not the log that the map was made of: {summary.get('source')}")
    if depths := sum(envelope.has_depth for envelope in envelopes):
        raise ConfigError(
            f"{path}: {counted(depths, 'frame has', 'frames have')} depth images, whose scale is not guessed; where "
            "poses alone have another scale, import the recording again with --scale"
        )
    if dig(summary, "map.corrected_poses"):
        raise ConfigError(f"{path}: lacks the corrected poses of the map; import it with a scale and map it with them")
    return np.array([envelope.T_world_camera for envelope in envelopes]).reshape(-1, 4, 4)[:, :3, 3]


def _factor(
    metres: float, points: tuple[Float64, Float64] | None, xyz: Float64, positions: Float64, floor: str
) -> tuple[float, str]:
    """Metres per unit, and how they are found."""
    if not len(xyz):
        raise MapError("the map shows no surface, and so no length that could be known; import the film with a scale")
    if points is None:
        middle = np.median(positions, axis=0)
        if floor and middle[2] > 0:  # of the import, at z = 0
            return scale_by_floor(metres, float(middle[2]), floor)
        seen = find_floor(xyz, middle, np.array((0.0, 0.0, 1.0)), _FLOOR_CONE_DEG)
        return scale_by_floor(metres, 0.0 if seen is None else seen.below, describe_floor(seen))
    for point in points:
        off = float(np.linalg.norm(xyz - point, axis=1).min())
        if off > _NEAR * np.ptp(xyz, axis=0).max():
            place = ",".join(f"{value:g}" for value in point)
            raise MapError(f"{place}: is {off:.3g} units from what is mapped; give points of the map as it is now")
    apart = float(np.linalg.norm(points[0] - points[1]))
    if apart < 1e-6:
        raise MapError("the two points are one; give two that are far apart")
    return metres / apart, f"two points of the map, {metres:g} m apart"
