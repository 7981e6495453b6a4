"""The map on disk: ``map.npz``, a zip of ``manifest.json`` and compressed .npy arrays that ``numpy.load`` can open.

Only voxels that hold something are stored: TSDF, weight and colour where there was a measurement, evidence and votes
where there was a vote. The manifest carries the format version, configuration, label set, counters, and for each
array its dtype, shape and SHA-256. A file appears under its name whole and flushed, or not at all.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig, convert_config, to_plain
from semantic_mapper.errors import ConfigError, LabelError, MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_grid import BLOCK_VOXELS
from semantic_mapper.mapping.map_types import MapState

FORMAT = "semantic-mapper voxel map"
FORMAT_VERSION = 1
_MANIFEST = "manifest.json"
_COMPRESSION_LEVEL = 1  # measured: higher levels take several times as long for a few percent
_HEADER_BYTES = 4096  # room for an .npy header


def write_map(path: Path, state: MapState) -> None:
    """Write a map, replacing a file of that name in one step.

    Raises:
        MapError: the file cannot be written; one that was there before is untouched.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            _write_members(file, state)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise MapError(f"{path}: cannot write the map: {error}") from error


def read_map(path: Path) -> MapState:
    """Read a map written by ``write_map``.

    Raises:
        MapError: no such file, not a map, of a newer format, or damaged; says which part.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = _read_manifest(path, archive)
            config, label_set = _read_settings(path, manifest)
            arrays = {name: _read_array(path, archive, name, entry) for name, entry in _entries(path, manifest, config)}
            return _unpack(path, manifest, config, label_set, arrays)
    except FileNotFoundError as error:
        raise MapError(f"{path}: no such map file") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError) as error:
        raise MapError(f"{path}: the map file is damaged or not a map: {error}. {_MEND}") from error


_MEND = "Use another copy, or make the map anew from its log with `semantic-mapper replay`"
_ARRAYS = {  # name -> (dtype, shape after the first axis; None = flat)
    "keys": ("<i4", (3,)),
    "measured": ("|u1", (BLOCK_VOXELS // 8,)),  # bit mask of the voxels with weight > 0
    "voted": ("|u1", (BLOCK_VOXELS // 8,)),  # bit mask of the voxels with votes > 0
    "tsdf": ("<f4", ()),
    "weight": ("<f4", ()),
    "color": ("<f4", (3,)),
    "evidence": ("<f4", None),  # (L,)
    "votes": ("<f4", ()),
}


def _pack(state: MapState) -> dict[str, NDArray[Any]]:
    measured, voted = state.weight > 0, state.votes > 0
    return {
        "keys": state.keys,
        "measured": np.packbits(measured, axis=1),
        "voted": np.packbits(voted, axis=1),
        "tsdf": state.tsdf[measured],
        "weight": state.weight[measured],
        "color": state.color[measured],
        "evidence": state.evidence[voted],
        "votes": state.votes[voted],
    }


def _unpack(
    path: Path, manifest: dict[str, Any], config: VoxelMapConfig, label_set: LabelSet, arrays: dict[str, NDArray[Any]]
) -> MapState:
    blocks = len(arrays["keys"])
    measured = np.unpackbits(arrays["measured"], axis=1).astype(bool)
    voted = np.unpackbits(arrays["voted"], axis=1).astype(bool)
    sizes = (len(measured), len(voted), len(arrays["tsdf"]), len(arrays["votes"]))
    if sizes != (blocks, blocks, int(measured.sum()), int(voted.sum())) or (
        len(arrays["weight"]) != sizes[2] or len(arrays["color"]) != sizes[2] or len(arrays["evidence"]) != sizes[3]
    ):
        raise MapError(f"{path}: the arrays do not fit each other ({blocks} blocks). {_MEND}")
    full: dict[str, NDArray[np.float32]] = {}
    for name, mask in {
        "tsdf": measured,
        "weight": measured,
        "color": measured,
        "evidence": voted,
        "votes": voted,
    }.items():
        full[name] = np.zeros((*mask.shape, *arrays[name].shape[1:]), np.float32)
        full[name][mask] = arrays[name]
    counters = manifest["counters"]
    return MapState(config, label_set, int(counters["frames"]), int(counters["last_stamp_ns"]), arrays["keys"], **full)


def _write_members(file: io.BufferedWriter, state: MapState) -> None:
    entries: dict[str, dict[str, Any]] = {}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION_LEVEL) as archive:
        for name, array in _pack(state).items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
            content = buffer.getbuffer()
            entries[name] = {
                "dtype": array.dtype.str,
                "shape": list(array.shape),
                "sha256": hashlib.sha256(content).hexdigest(),
            }
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(content)
        archive.writestr(_MANIFEST, json.dumps(_manifest(state, entries), indent=1))


def _manifest(state: MapState, entries: dict[str, dict[str, Any]]) -> dict[str, Any]:
    labels = state.label_set
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "config": to_plain(state.config),
        "label_set": {
            "name": labels.name,
            "ids": labels.ids,
            "names": labels.names,
            "colors": labels.colors,
            "ignore_id": labels.ignore_id,
        },
        "counters": {"frames": state.frames, "last_stamp_ns": state.last_stamp_ns, "blocks": len(state.keys)},
        "arrays": entries,
    }


def _read_manifest(path: Path, archive: zipfile.ZipFile) -> dict[str, Any]:
    try:
        manifest = json.loads(archive.read(_MANIFEST))
        kind, version = manifest["format"], int(manifest["version"])
    except (KeyError, ValueError, TypeError) as error:
        raise MapError(f"{path}: not a map file: no readable {_MANIFEST} ({error}). {_MEND}") from error
    if kind != FORMAT:
        raise MapError(f"{path}: not a voxel map but '{kind}'")
    if version != FORMAT_VERSION:
        raise MapError(
            f"{path}: map format {version}, this version reads format {FORMAT_VERSION}; update semantic-mapper "
            "or make the map anew from its log"
        )
    return manifest


def _read_settings(path: Path, manifest: dict[str, Any]) -> tuple[VoxelMapConfig, LabelSet]:
    try:
        config = convert_config(manifest["config"], VoxelMapConfig, f"{path}: {_MANIFEST}")
        labels = manifest["label_set"]
        label_set = LabelSet(
            str(labels["name"]),
            tuple(int(i) for i in labels["ids"]),
            tuple(str(n) for n in labels["names"]),
            tuple((int(r), int(g), int(b)) for r, g, b in labels["colors"]),
            int(labels["ignore_id"]),
        )
        _ = int(manifest["counters"]["frames"]), int(manifest["counters"]["last_stamp_ns"])
    except (KeyError, ValueError, TypeError, LabelError, ConfigError) as error:
        raise MapError(f"{path}: {_MANIFEST} cannot be used: {error}. {_MEND}") from error
    return config, label_set


def _entries(path: Path, manifest: dict[str, Any], config: VoxelMapConfig) -> list[tuple[str, dict[str, Any]]]:
    """The manifest's array entries, checked against the format before anything is allocated for them."""
    classes = len(manifest["label_set"]["ids"])
    checked = []
    for name, (dtype, tail) in _ARRAYS.items():
        try:
            entry = manifest["arrays"][name]
            shape = tuple(int(n) for n in entry["shape"])
            fits = entry["dtype"] == dtype and shape[1:] == ((classes,) if tail is None else tail)
            fits = fits and 0 <= shape[0] <= config.max_blocks * BLOCK_VOXELS
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise MapError(f"{path}: {_MANIFEST} says nothing usable of array '{name}' ({error}). {_MEND}") from error
        if not fits:
            raise MapError(f"{path}: array '{name}' has dtype {entry['dtype']} and shape {shape}: not of this format")
        checked.append((name, {"dtype": dtype, "shape": shape, "sha256": entry.get("sha256")}))
    return checked


def _read_array(path: Path, archive: zipfile.ZipFile, name: str, entry: dict[str, Any]) -> NDArray[Any]:
    member = f"{name}.npy"
    expected = int(np.prod(entry["shape"])) * np.dtype(entry["dtype"]).itemsize
    try:
        size = archive.getinfo(member).file_size
        content = archive.read(member) if size <= expected + _HEADER_BYTES else b""
    except KeyError as error:
        raise MapError(f"{path}: array '{name}' is missing. {_MEND}") from error
    except zipfile.BadZipFile as error:
        raise MapError(f"{path}: array '{name}' is damaged: {error}. {_MEND}") from error
    if hashlib.sha256(content).hexdigest() != entry["sha256"]:
        raise MapError(f"{path}: array '{name}' is damaged: its SHA-256 is not the manifest's. {_MEND}")
    array = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    if array.dtype.str != entry["dtype"] or array.shape != entry["shape"]:
        raise MapError(
            f"{path}: array '{name}' is {array.dtype.str} {array.shape}, not what the manifest says. {_MEND}"
        )
    return array


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
