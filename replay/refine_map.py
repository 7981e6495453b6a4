"""Relabel a saved map."""

from pathlib import Path

from semantic_mapper.fields.nesf import find_nesf
from semantic_mapper.mapping.refine import RefineReport, refine
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.exporters.map_files import parse_up
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.run_folder import prepare_file


def refine_map(
    path: Path,
    out: Path,
    weights: Path | None = None,
    *,
    fill: float = 0.5,
    up: str = "auto",
    by_name: bool = False,
    monitor: JobMonitor | None = None,
) -> tuple[RefineReport, str]:
    """Relabel a saved map by its shape, colour and votes, into a new one; what has changed, and the digest of the
    network, or ``smoothed``.

    Raises ConfigError: ``up`` is no direction, or the new map cannot be written there. MapError, WeightsError: map and
    weights cannot be read, or do not go together.

    ``weights`` may be ``smoothed``; None = those that ship, or smoothing for a map of other classes. Surface without
    votes gets a class that is at least as likely as ``fill``, 1 = never. ``up`` is ``auto``, an axis, or three numbers;
    ``by_name`` matches weights of other classes by the names of these.
    """
    monitor = monitor or JobMonitor()
    direction = parse_up(up)
    prepare_file(out)
    voxel_map = VoxelMap.load(path)
    network = find_nesf(weights, voxel_map.label_set)

    def on_tile(done: int, total: int) -> None:
        if done == 1:
            monitor.start(total)
        monitor.set(done)

    report = refine(voxel_map, network, fill=fill, up=direction, by_name=by_name, on_tile=on_tile)
    voxel_map.save(out)
    return report, network.digest
