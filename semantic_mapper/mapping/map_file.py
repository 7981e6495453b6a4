"""The map on disk: ``map.npz``, a zip of compressed .npy arrays in chunks of blocks, and ``manifest.json``.

``numpy.load`` opens it: array ``tsdf`` of the first chunk is ``"000000/tsdf"``. TSDF, weight and colour are stored
where there was a measurement, evidence and votes where there was a vote. Blocks stand in lexicographic order, and the
same map gives the same bytes. The manifest holds settings, classes, and a SHA-256 of each chunk; its own is the comment
of the zip. Writing and reading take memory for one chunk."""

from __future__ import annotations

import hashlib
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import NotNegative, VoxelMapConfig, convert_config
from semantic_mapper.errors import ConfigError, MapError, PoseError
from semantic_mapper.files import atomic_write, open_regular
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.localization.places import DESCRIPTOR_BYTES, Place
from semantic_mapper.mapping.block_grid import BLOCK_SIDE
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, KEY_LIMIT, BlockValues, PackedBlocks, pack_blocks, pack_keys
from semantic_mapper.mapping.changes import NONE_CLEARED, BlockChanges, CopiedChanges, Decision, empty_changes
from semantic_mapper.mapping.fusion import SURFACE_WEIGHT
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.types import Int32, Int64

FORMAT = "semantic-mapper voxel map"
FORMAT_VERSION = 4
MAX_OBJECT_BYTES = 64 << 20
CHUNK_BLOCKS = 256  # at most; what is in memory at a time while a map is saved or loaded
_CHUNKS_AT_ONCE = 256  # that a mirror takes over: it sorts the keys of all blocks each time
ADVICE = "Use another copy, or make the map again from its log with `semantic-mapper map`"

Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
Corner = tuple[float, float, float]

BlockPart = tuple[Int32, BlockValues]  # keys (B, 3) and voxels

_MANIFEST = "manifest.json"
_MAX_MANIFEST_BYTES = 64 << 20  # 100 million blocks
_COMMENT = b"sha256 of manifest.json: "
_COMMENT_BYTES = len(_COMMENT) + 64
_END_BYTES = 22 + _COMMENT_BYTES  # of a zip's last record
_COMPRESSION_LEVEL = 1  # measured: higher levels take several times as long for a few percent
_ARRAYS = {  # name -> dtype; in the order of the file
    "keys": "<i4",  # (B, 3) block coordinates
    "measured": "|u1",  # (B, 64) bit mask of the voxels with weight > 0: M of them
    "voted": "|u1",  # (B, 64) bit mask of the voxels with votes > 0: V of them
    "tsdf": "<f4",  # (M,)
    "weight": "<f4",  # (M,)
    "color": "<f4",  # (M, 3)
    "evidence": "<u2",  # (V, L)
    "votes": "<f4",  # (V,)
}
_PLACES = {  # of ``Place``; only where there are any
    "pose": "<f8",  # (P, 4, 4)
    "stamp_ns": "<i8",  # (P,)
    "camera": "<i4",  # (P,) number of a name in the manifest
    "features": "<i4",  # (P,) how many of the rows below are each place's
    "points": "<f4",  # (N, 3)
    "descriptors": "|u1",  # (N, 128)
}
_OBJECTS = {"data": "|u1"}  # (N,) bytes of ``queries.objects.ObjectMemory``; only where there are any
_UNREADABLE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, OverflowError, OSError)


class MapChunk(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Blocks that are stored together, their voxels that are measured and that have votes, SHA-256 of their arrays."""

    blocks: Annotated[int, msgspec.Meta(ge=1, le=CHUNK_BLOCKS)]
    measured: Annotated[int, msgspec.Meta(ge=0, le=CHUNK_BLOCKS * BLOCK_VOXELS)]
    voted: Annotated[int, msgspec.Meta(ge=0, le=CHUNK_BLOCKS * BLOCK_VOXELS)]
    sha256: Digest


class PlaceTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The places that the map is found again by (``localization.places``), their features, the cameras of them."""

    places: NotNegative
    features: NotNegative
    cameras: tuple[str, ...]
    sha256: Digest


class ObjectTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The objects that the map remembers, in bytes of ``queries.objects.ObjectMemory``."""

    bytes: Annotated[int, msgspec.Meta(ge=1, le=MAX_OBJECT_BYTES)]
    sha256: Digest


class MapManifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is known of a saved map without reading its blocks."""

    format: str = FORMAT
    version: int = FORMAT_VERSION
    config: VoxelMapConfig
    label_set: LabelSet
    frames: NotNegative
    last_stamp_ns: Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
    blocks: NotNegative = 0  # blocks of 8^3 voxels
    # lowest and highest corner of all blocks, metres in the world; None of an empty map
    bounds_m: tuple[Corner, Corner] | None = None
    chunks: tuple[MapChunk, ...] = ()  # in the order of the file
    scale: Literal["metres", "unknown"] = "metres"  # whether lengths are metres
    # digest of the weights that refined the map; empty where none did
    refined: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")] = ""
    places: PlaceTable | None = None  # what it is found again by
    objects: ObjectTable | None = None  # what it remembers of its things

    @property
    def scale_known(self) -> bool:
        """Whether lengths are metres."""
        return self.scale != SCALE_UNKNOWN


def parse_manifest(content: bytes, where: str) -> MapManifest:
    """Read a manifest and check it: ``MapError`` where it is another file, another version, or impossible."""
    try:
        plain = msgspec.json.decode(content, type=dict[str, Any])
        kind, version = plain["format"], plain["version"]
    except (msgspec.DecodeError, KeyError, ValueError, RecursionError) as error:
        raise MapError(f"{where}: not a map file: cannot be read ({error}). {ADVICE}") from error
    if kind != FORMAT:
        raise MapError(f"{where}: not a voxel map but '{kind}'")
    if version != FORMAT_VERSION:
        raise MapError(
            f"{where}: map format {version}, this version reads format {FORMAT_VERSION}; make the map again from its "
            "log with `semantic-mapper map`, or read it with the version of semantic-mapper that wrote it"
        )
    try:
        manifest = convert_config(plain, MapManifest, where)
    except ConfigError as error:
        raise MapError(f"{error}. {ADVICE}") from error
    chunks, blocks = manifest.chunks, manifest.blocks
    fits = blocks == sum(chunk.blocks for chunk in chunks) and blocks <= manifest.config.max_blocks
    if not fits or any(max(c.measured, c.voted) > c.blocks * BLOCK_VOXELS for c in chunks):
        raise MapError(f"{where}: its chunks do not hold {blocks} blocks, or more than max_blocks allows. {ADVICE}")
    return manifest


def write_map(
    path: Path, manifest: MapManifest, parts: Iterable[BlockPart], places: Sequence[Place] = (), objects: bytes = b""
) -> MapManifest:
    """Write a map in one step; returns the manifest with what depends on the blocks filled in. ``parts`` are blocks in
    lexicographic order, ``CHUNK_BLOCKS`` at a time. ``MapError``: it cannot be; a file from before stays."""
    chunks: list[MapChunk] = []
    corners: list[Int32] = []
    try:
        with (
            atomic_write(path, sync="folder") as file,
            zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION_LEVEL) as archive,
        ):
            for keys, values in parts:
                chunks.append(_write_chunk(archive, len(chunks), keys, values))
                corners += [keys.min(axis=0), keys.max(axis=0) + 1]
            manifest = msgspec.structs.replace(
                manifest,
                blocks=sum(chunk.blocks for chunk in chunks),
                bounds_m=_bounds_m(corners, manifest.config.voxel_size_m),
                chunks=tuple(chunks),
                places=_write_places(archive, places) if places else None,
                objects=_write_objects(archive, objects) if objects else None,
            )
            content = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
            with archive.open(_MANIFEST, "w") as member:
                member.write(content)
            archive.comment = _comment(content)
    except OSError as error:
        raise MapError(
            f"{path}: cannot write the map: {error.strerror or error}; make room, or choose another folder"
        ) from error
    return manifest


def describe_map(path: Path) -> MapManifest:
    """What a saved map says of itself, without its blocks; ``MapError``: missing, damaged or of another format."""
    with open_map(path) as reader:
        return reader.manifest


@contextmanager
def open_map(path: Path) -> Iterator[MapReader]:
    """Open a saved map to be read chunk by chunk; ``MapError`` as of ``describe_map``."""
    try:
        file = open_regular(path)
    except FileNotFoundError as error:
        raise MapError(f"{path}: no such map file") from error
    except (ConfigError, OSError) as error:
        raise MapError(f"{path}: damaged or not a map: {error}") from error
    with file:
        with _explained(f"{path}: damaged or not a map"):
            archive = zipfile.ZipFile(file)
        with archive:
            yield MapReader(path, archive, _read_manifest(path, file, archive))


class MapReader:
    """A saved map that is open; ``manifest`` is checked, ``digest`` is its SHA-256 and so that of the map."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, manifest: MapManifest) -> None:
        self.manifest = manifest
        self.digest = archive.comment.removeprefix(_COMMENT).decode("ascii")
        self._path = path
        self._archive = archive

    def parts(self) -> Iterator[BlockPart]:
        """All blocks in lexicographic order, a chunk at a time, each checked: ``MapError`` says which is damaged."""
        last = -1
        for n, chunk in enumerate(self.manifest.chunks):
            where = f"{self._path}: chunk {n} of {len(self.manifest.chunks)}"
            keys, values = self._read_chunk(n, chunk, where)
            packed = pack_keys(keys)
            if np.abs(keys.astype(np.int64)).max() >= KEY_LIMIT or not (np.diff(packed, prepend=last) > 0).all():
                raise MapError(f"{where}: block coordinates are out of range or not in order. {ADVICE}")
            last = int(packed[-1])
            yield keys, values
            del values  # while the next ones are read

    def changes(self) -> Iterator[BlockChanges]:
        """What ``VoxelMap.changes(0)`` of the loaded map gives, in parts, one in memory; each ends at its version."""
        saved, config, parts = self.manifest, self.manifest.config, self.parts()
        decision = Decision(config.vote_discount, config.unknown_below, SURFACE_WEIGHT)
        for start in range(0, max(len(saved.chunks), 1), _CHUNKS_AT_ONCE):
            chunks = saved.chunks[start : start + _CHUNKS_AT_ONCE]
            keys, versions = np.empty((sum(c.blocks for c in chunks), 3), np.int32), (0, saved.frames, saved.frames, 0)
            result = empty_changes(*versions, keys, scale_known=saved.scale_known, cleared=NONE_CLEARED)
            packed = _packed_into(keys, islice(parts, len(chunks)))
            yield CopiedChanges(result, packed, saved.label_set, decision).compact()

    def places(self) -> tuple[Place, ...]:
        """What the map is found again by, nothing where it does not say; ``MapError`` where it is damaged."""
        table = self.manifest.places
        if table is None:
            return ()
        where = f"{self._path}: its places"
        one, all_ = (table.places,), table.features
        sizes = ((*one, 4, 4), one, one, one, (all_, 3), (all_, DESCRIPTOR_BYTES))
        arrays = self._read_arrays("places", _PLACES, sizes, table.sha256, where)
        counts, camera = arrays["features"], arrays["camera"]
        sound = (counts >= 0).all() and counts.sum() == all_ and np.isfinite(arrays["points"]).all()
        if not (sound and (camera >= 0).all() and (camera < len(table.cameras)).all()):
            raise MapError(f"{where}: their numbers do not fit each other. {ADVICE}")
        ends = np.cumsum(counts)
        places: list[Place] = []
        for n, pose in enumerate(arrays["pose"]):
            try:
                check_pose(pose, where)
            except PoseError as error:
                raise MapError(f"{error}. {ADVICE}") from error
            rows = slice(int(ends[n] - counts[n]), int(ends[n]))
            name, stamp_ns = table.cameras[camera[n]], int(arrays["stamp_ns"][n])
            places.append(Place(name, stamp_ns, pose, arrays["points"][rows], arrays["descriptors"][rows]))
        return tuple(places)

    def objects(self) -> bytes:
        """What the map remembers of its things, nothing where it does not; ``MapError`` where it is damaged."""
        table = self.manifest.objects
        if table is None:
            return b""
        where = f"{self._path}: its objects"
        return self._read_arrays("objects", _OBJECTS, ((table.bytes,),), table.sha256, where)["data"].tobytes()

    def _read_chunk(self, n: int, chunk: MapChunk, where: str) -> BlockPart:
        mask, measured, voted = (chunk.blocks, BLOCK_VOXELS // 8), (chunk.measured,), (chunk.voted,)
        classes = len(self.manifest.label_set)
        shapes = ((chunk.blocks, 3), mask, mask, measured, measured, (*measured, 3), (*voted, classes), voted)
        arrays = self._read_arrays(f"{n:06d}", _ARRAYS, shapes, chunk.sha256, where)
        masks = {name: np.unpackbits(arrays[name], axis=1).astype(np.bool_) for name in ("measured", "voted")}
        if any(int(mask.sum()) != getattr(chunk, name) for name, mask in masks.items()):
            raise MapError(f"{where}: its masks and its values do not fit each other. {ADVICE}")
        full: dict[str, NDArray[Any]] = {}
        for name in BlockValues._fields:
            mask = masks["voted" if name in ("evidence", "votes") else "measured"]
            full[name] = np.zeros((*mask.shape, *arrays[name].shape[1:]), arrays[name].dtype)
            full[name][mask] = arrays[name]
        return arrays["keys"], BlockValues(**full)

    def _read_arrays(
        self, folder: str, dtypes: dict[str, str], shapes: Sequence[tuple[int, ...]], sha256: str, where: str
    ) -> dict[str, NDArray[Any]]:
        arrays: dict[str, NDArray[Any]] = {}
        hashed = hashlib.sha256()
        for (name, dtype), shape in zip(dtypes.items(), shapes, strict=True):
            head = _npy_head(dtype, shape)
            size = len(head) + int(np.prod(shape)) * np.dtype(dtype).itemsize
            content = _read_member(self._archive, f"{folder}/{name}.npy", size, f"{where}: {name}")
            if not content.startswith(head):
                raise MapError(f"{where}: {name} is not an array {dtype} of shape {shape}. {ADVICE}")
            hashed.update(content)
            arrays[name] = np.frombuffer(content, dtype, offset=len(head)).reshape(shape)
        if hashed.hexdigest() != sha256:
            raise MapError(f"{where} is damaged: its SHA-256 is not the manifest's. {ADVICE}")
        return arrays


def _packed_into(keys: Int32, parts: Iterable[BlockPart]) -> Iterator[tuple[Int64, PackedBlocks]]:
    """Blocks, packed, and their rows in ``keys``, which are filled."""
    row = 0
    for part, values in parts:
        rows = np.arange(row, row + len(part))
        keys[rows] = part
        yield rows, pack_blocks(values, np.arange(len(part), dtype=np.int32))
        row += len(part)
        del values  # while the next ones are read


def _write_chunk(archive: zipfile.ZipFile, n: int, keys: Int32, values: BlockValues) -> MapChunk:
    measured, voted = values.weight > 0, values.votes > 0
    arrays = {
        "keys": keys,
        "measured": np.packbits(measured, axis=1),
        "voted": np.packbits(voted, axis=1),
        "tsdf": values.tsdf[measured],
        "weight": values.weight[measured],
        "color": values.color[measured],
        "evidence": values.evidence[voted],
        "votes": values.votes[voted],
    }
    found = _write_arrays(archive, f"{n:06d}", arrays, _ARRAYS)
    return MapChunk(blocks=len(keys), measured=int(measured.sum()), voted=int(voted.sum()), sha256=found)


def _write_places(archive: zipfile.ZipFile, places: Sequence[Place]) -> PlaceTable:
    cameras = tuple(sorted({p.camera_id for p in places}))
    arrays = {
        "pose": np.stack([p.T_world_camera for p in places]),
        "stamp_ns": np.array([p.stamp_ns for p in places]),
        "camera": np.array([cameras.index(p.camera_id) for p in places]),
        "features": np.array([len(p.points) for p in places]),
        "points": np.concatenate([p.points for p in places]),
        "descriptors": np.concatenate([p.descriptors for p in places]),
    }
    found = _write_arrays(archive, "places", arrays, _PLACES)
    return PlaceTable(places=len(places), features=len(arrays["points"]), cameras=cameras, sha256=found)


def _write_objects(archive: zipfile.ZipFile, objects: bytes) -> ObjectTable:
    found = _write_arrays(archive, "objects", {"data": np.frombuffer(objects, np.uint8)}, _OBJECTS)
    return ObjectTable(bytes=len(objects), sha256=found)


def _write_arrays(
    archive: zipfile.ZipFile, folder: str, arrays: dict[str, NDArray[Any]], dtypes: dict[str, str]
) -> str:
    """Write arrays in the order of ``dtypes``; returns their SHA-256."""
    hashed = hashlib.sha256()
    for name, dtype in dtypes.items():
        array = np.ascontiguousarray(arrays[name], dtype)
        with archive.open(f"{folder}/{name}.npy", "w") as member:
            for content in (_npy_head(dtype, array.shape), array.reshape(-1).view(np.uint8).data):
                hashed.update(content)
                member.write(content)
    return hashed.hexdigest()


def _npy_head(dtype: str, shape: tuple[int, ...]) -> bytes:
    """What stands before the values in an .npy file of version 1.0; NumPy's own differs between its versions."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape!r}, }}"
    padded = text.ljust(128 - 10 - 1) + "\n"  # starts on a multiple of 64 bytes
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded.encode("ascii")


def _bounds_m(corners: list[Int32], voxel_size_m: float) -> Any:
    if not corners:
        return None
    both = np.stack((np.min(corners, axis=0), np.max(corners, axis=0))) * (BLOCK_SIDE * voxel_size_m)
    return tuple(tuple(float(x) for x in corner) for corner in both)


def _read_manifest(path: Path, file: BinaryIO, archive: zipfile.ZipFile) -> MapManifest:
    where = f"{path}: {_MANIFEST}"
    names = archive.namelist()
    if _MANIFEST not in names:
        raise MapError(f"{path}: not a map file: there is no {_MANIFEST} in it")
    size = archive.getinfo(_MANIFEST).file_size
    if size > _MAX_MANIFEST_BYTES:
        raise MapError(f"{where} is damaged: {size} bytes are too many. {ADVICE}")
    content = _read_member(archive, _MANIFEST, size, where)
    manifest = parse_manifest(content, where)
    with _explained(f"{path}: cannot be read"):
        file.seek(-_END_BYTES, 2)
        end = file.read()
    expected = [f"{n:06d}/{name}.npy" for n in range(len(manifest.chunks)) for name in _ARRAYS]
    expected += [] if manifest.places is None else [f"places/{name}.npy" for name in _PLACES]
    expected += [] if manifest.objects is None else [f"objects/{name}.npy" for name in _OBJECTS]
    whole = end.startswith(b"PK\5\6") and end[-_COMMENT_BYTES:] == archive.comment == _comment(content)
    if not whole or names != [*expected, _MANIFEST]:
        raise MapError(f"{path}: damaged: it is cut off or changed, or arrays are missing. {ADVICE}")
    return manifest


def _read_member(archive: zipfile.ZipFile, name: str, size: int, where: str) -> bytes:
    """A member that must have ``size`` bytes."""
    info = archive.getinfo(name)
    if info.file_size != size or info.compress_type != zipfile.ZIP_DEFLATED or info.flag_bits & 1:
        raise MapError(f"{where} is damaged: not {size} compressed bytes. {ADVICE}")
    with _explained(f"{where} is damaged"), archive.open(info) as member:
        content = member.read()
    if len(content) != size:
        raise MapError(f"{where} is damaged: {len(content)} bytes instead of {size}. {ADVICE}")
    return content


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """What zip and decompression find wrong is an error of ours."""
    try:
        yield
    except _UNREADABLE as error:
        raise MapError(f"{what}: {error}. {ADVICE}") from error


def _comment(manifest: bytes) -> bytes:
    """Of the zip."""
    return _COMMENT + hashlib.sha256(manifest).hexdigest().encode()
