"""Examinations of what the nodes of a launch file are given: what each of them would refuse as it starts."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from semantic_mapper.config import load_config, load_mapper_config
from semantic_mapper.drivers.registry import find_cameras
from semantic_mapper.errors import CameraError, ConfigError, SemanticMapperError
from semantic_mapper.nodes.doctor.check import Check, failed
from semantic_mapper.nodes.launcher.launch_file import Launch, NodeEntry
from semantic_mapper.nodes.options import (
    CameraOptions,
    FinetunerOptions,
    FoxgloveOptions,
    LiveCamera,
    MapperOptions,
    table_of,
)
from semantic_mapper.training.config import OnlineConfig


def node_settings(launch: Launch) -> Iterator[Check]:
    """One check a node that has settings beyond its options: files that it reads, tables of its camera and poses."""
    for entry in launch.nodes:
        try:
            found = _settings(entry, launch)
        except SemanticMapperError as error:
            yield failed(entry.name, error)
        else:
            if found:
                yield Check(entry.name, "ok", found)


def _settings(entry: NodeEntry, launch: Launch) -> str:
    """What was found to be right.

    Raises:
        SemanticMapperError: something is not.
    """
    match launch.options[entry.name]:
        case CameraOptions(camera=None, log=str(log)):
            if not Path(log).exists():
                raise ConfigError(f"{log}: no such log")
            return log
        case CameraOptions(camera=live) if live is not None:
            from semantic_mapper.nodes.camera.live import check_world, make_source  # loads GTSAM

            make_source(live)
            if entry.restart != "never":
                check_world(entry.name, live)
            return f"{_connected(live)}; its settings and poses"
        case MapperOptions() as options:
            path = Path(options.config) if options.config else None
            load_mapper_config(path, {"voxel_map.voxel_size_m": options.voxel_size_m or None})
            return _weights(options.weights)
        case FinetunerOptions() as options:
            if options.config:
                load_config(Path(options.config), OnlineConfig)
            return _weights(options.weights)
        case FoxgloveOptions():
            import_module("semantic_mapper.nodes.foxglove.server")
            return "its package"
        case _:
            return ""


def _connected(live: LiveCamera) -> str:
    """The camera, by its address.

    Raises:
        CameraError: it is not there.
    """
    device = str(table_of(live.config, "camera.config")[0].get("device", ""))
    # Files and streams are named, not found; a device file has several names; an IP address may lie behind a router.
    named = live.kind == "opencv" or (live.kind == "stereo" and device and not device.startswith("/dev/"))
    if named or Path(device).is_char_device() or device.count(".") == 3:
        return f"{live.kind} {device}".rstrip()
    found, unknown = find_cameras((live.kind,))
    if live.kind in unknown:
        raise CameraError(unknown[live.kind])
    addresses = [camera.address for camera in found]
    if device in addresses or (addresses and not device):
        return f"{live.kind} {device or addresses[0]}"
    missing = f"{live.kind} {device} is not connected" if device else f"no {live.kind} camera is connected"
    there = f", there are {', '.join(addresses)}" if addresses else ""
    raise CameraError(f"camera '{live.id}': {missing}{there}; plug it in (`up` waits for it)")


def _weights(named: str) -> str:
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint

    path = Path(named) if named else default_checkpoint_path()
    load_checkpoint(path)
    return f"settings, and weights {path.name}"
