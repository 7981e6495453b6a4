"""Saved maps of one building fused into one map, which keeps in memory what was used last and the rest on disk."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.config import read_json
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.geometry import check_pose, rotation_vector, yaw_transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.map_alignment import AlignmentError, find_alignment
from semantic_mapper.mapping.map_file import MapManifest, describe_map
from semantic_mapper.mapping.map_types import require_same_scale
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.fleet.store import Store, fetch, is_store, is_url
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.queries.graph import GraphTracker
from semantic_mapper.queries.objects import ObjectMemory, brought_up
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.replay.run_folder import LOG_SUFFIX, MAP_NAME, MAP_SUFFIX, map_path
from semantic_mapper.types import Float64

_log = get_logger(__name__)
MEMORY_MB = 1000  # of the merged map, and of the one that is added to it
_MAX_BLOCKS = 1 << 27
_WAY_OUT = 'give their poses: --poses FILE, with {"NAME": [x, y, z, yaw_deg], ...}; all 0 where they are in one world'


@dataclass(frozen=True, slots=True, eq=False)
class MergeReport:
    """What a merge has done."""

    merged: VoxelMap
    poses: Mapping[str, Float64]  # T_world_map (4, 4) float64 by name, in the order in which the maps were added
    notes: tuple[str, ...]  # how the pose of each is known, likewise


def merge_maps(
    sources: Mapping[str, str], given: Mapping[str, Float64], on_added: Callable[[], object] = lambda: None
) -> MergeReport:
    """Fuse saved maps; at most two are loaded at a time, each within ``MEMORY_MB``.

    The first map and those with a given T_world_map (4, 4) are added in their order; the first one is the world where
    none has any. Each other one is found by the places it shares with what was merged so far; found maps help to find
    others. ``sources`` are those of ``find_maps``; ``on_added`` is called after each.

    Raises ConfigError: a pose of no map. MapError: maps that do not fit each other, are the same, have seen the same
    frames, or fit nowhere; or a map cannot be read. StoreError: a map cannot be fetched.
    """
    names = list(sources)
    if unknown := sorted(set(given) - set(names)):
        raise ConfigError(f"--poses names {', '.join(unknown)}, but the maps are {', '.join(names)}")
    known = given or {names[0]: np.eye(4)}
    poses: dict[str, Float64] = {}
    notes: list[str] = []
    memory = ObjectMemory()
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-merge-") as folder:
        files = {name: fetch(url, Path(folder) / f"{n}.npz") for n, (name, url) in enumerate(sources.items())}
        whole = _empty_map({name: describe_map(file) for name, file in files.items()})
        waiting = sorted(names, key=lambda name: name not in known)
        while waiting:
            refused: dict[str, str] = {}
            for name in waiting:
                loaded = VoxelMap.load(files[name], memory_mb=_memory_mb(describe_map(files[name])))
                try:
                    if name in known:
                        T_world_map, note = known[name], "pose as given" if given else "the world is its own"
                    else:
                        found = find_alignment(whole, loaded)
                        T_world_map = found.T_map_other
                        where, turn = T_world_map[:3, 3], np.degrees(np.linalg.norm(rotation_vector(T_world_map)))
                        note = (
                            f"{found.agreeing} of {found.looked_for} places found in the maps before it; at "
                            f"({where[0]:.2f}, {where[1]:.2f}, {where[2]:.2f}), turned by {turn:.1f} degrees"
                        )
                    objects = brought_up(loaded) or ObjectMemory()
                    whole.add(loaded, T_world_map)
                    memory.join(objects.moved_by(T_world_map))
                except MapError as error:
                    refused[name] = f"{error}; {_WAY_OUT}" if isinstance(error, AlignmentError) else str(error)
                    continue
                poses[name] = T_world_map
                notes.append(f"{name}: {note}")
                on_added()
            if list(refused) == waiting:
                reasons = "; ".join(f"{name}: {reason}" for name, reason in refused.items())
                raise MapError(f"these maps cannot be added; leave them out, or do as it says: {reasons}")
            waiting = list(refused)
    if len(memory):
        graphs = GraphTracker()
        try:
            graphs.update(MapMirror.of(whole).snapshot(), ())
        except MapError as error:
            _log.warning("rooms_not_known", reason=str(error))
        memory.put_in_rooms(graphs.room_of)  # those of the whole
        whole.objects = memory.to_bytes()
    return MergeReport(whole, poses, tuple(notes))


def find_maps(arguments: Sequence[str]) -> dict[str, str]:
    """Paths and URLs of the maps that are meant, by the name of the file, of the folder of a ``map.npz``, or of the log
    that it was made of; by the path or URL itself where two have the same name.

    Arguments are paths or URLs of map files, of folders with a ``map.npz``, or of stores: the latest replay of each of
    its logs. Raises ConfigError: fewer than two maps, or no such map. StoreError: a store cannot be reached.
    """
    found: list[tuple[str, str]] = []
    for argument in arguments:
        if not argument.endswith(MAP_SUFFIX) and is_store(argument):
            store = Store(argument)
            replays = sorted((r for r in store.results() if r.operation == "map"), key=lambda r: r.finished_ns)
            latest = {result.log_digest: result for result in replays}.values()
            found += sorted((_stem(r.log), f"{store.url}/{r.folder}/{MAP_NAME}") for r in latest)
            continue
        if not is_url(argument):
            url = str(map_path(Path(argument)).absolute())
        else:
            url = argument if argument.endswith(MAP_SUFFIX) else f"{argument.rstrip('/')}/{MAP_NAME}"
        found.append((_stem(url.removesuffix(f"/{MAP_NAME}")), url))
    stems = [stem for stem, _ in found]
    named = {stem if stems.count(stem) == 1 else without_secrets(url): url for stem, url in found}
    if len(named) < 2:
        raise ConfigError(f"a merge needs two maps or more; these are: {', '.join(named) or 'none'}")
    return named


def read_poses(path: Path) -> dict[str, Float64]:
    """T_world_map (4, 4) float64 by the names of maps.

    Raises ConfigError: the file cannot be read, or holds something else. PoseError: a matrix is no rigid transform.

    The file is JSON, an object whose values are 4 rows of 4 numbers (T_world_map) or [x, y, z, yaw_deg], yaw about +z.
    """
    poses: dict[str, Float64] = {}
    for name, values in read_json(path, dict[str, list[Any]]).items():
        where = f"{path}: {name}"
        try:
            T = np.array(values, np.float64)
            T = yaw_transform(T[:3], float(T[3])) if T.shape == (4,) else T.reshape(4, 4)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{where}: expected 4 rows of 4 numbers or [x, y, z, yaw_deg] ({error})") from error
        check_pose(T, where)
        poses[name] = T
    return poses


def _empty_map(manifests: Mapping[str, MapManifest]) -> VoxelMap:
    """With the settings of the first map and room for all. Raises MapError: two are one, or some have no metres."""
    seen: dict[bytes, str] = {}
    first_name, first = next(iter(manifests.items()))
    for name, manifest in manifests.items():
        require_same_scale(first.scale_known, manifest.scale_known, f"{first_name} and {name}")
        chunks = msgspec.json.encode(manifest.chunks)
        if manifest.chunks and (twin := seen.setdefault(chunks, name)) != name:
            raise MapError(f"{twin} and {name} are the same map: all that it has seen would count twice")
    # A block that is turned reaches into at most 8 others.
    blocks = min(8 * sum(manifest.blocks for manifest in manifests.values()), _MAX_BLOCKS)
    config = msgspec.structs.replace(
        first.config, memory_mb=_memory_mb(first), max_blocks=max(first.config.max_blocks, blocks)
    )
    return VoxelMap(config, first.label_set)


def _memory_mb(manifest: MapManifest) -> int:
    return min(manifest.config.memory_mb or MEMORY_MB, MEMORY_MB)


def _stem(url: str) -> str:
    return url.rstrip("/").rsplit("/", 1)[-1].removesuffix(MAP_SUFFIX).removesuffix(LOG_SUFFIX)
