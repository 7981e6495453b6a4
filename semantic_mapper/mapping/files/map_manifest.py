"""What a map file says of itself: settings, classes, counters, and what each chunk of blocks holds."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any, Literal

import msgspec

from semantic_mapper.config import Config, NotNegative, VoxelMapConfig, convert_config
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.storage.block_store import BLOCK_VOXELS
from semantic_mapper.transport.messages import SCALE_UNKNOWN

FORMAT = "semantic-mapper voxel map"
FORMAT_VERSION = 2
CHUNK_BLOCKS = 256  # at most; what is in memory at a time while a map is saved or loaded
MEND = "Use another copy, or make the map again from its log with `semantic-mapper replay`"

Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
Corner = tuple[float, float, float]


class MapChunk(Config, frozen=True):
    """Blocks that are stored together.

    Args:
        blocks: How many.
        measured, voted: Their voxels with a depth measurement, and with a class vote.
        sha256: Of the chunk's arrays, in their order.
    """

    blocks: Annotated[int, msgspec.Meta(ge=1, le=CHUNK_BLOCKS)]
    measured: Annotated[int, msgspec.Meta(ge=0, le=CHUNK_BLOCKS * BLOCK_VOXELS)]
    voted: Annotated[int, msgspec.Meta(ge=0, le=CHUNK_BLOCKS * BLOCK_VOXELS)]
    sha256: Digest


class InstanceTable(Config, frozen=True):
    """The voxels that belong to things (``instance_layer``).

    Args:
        voxels: How many.
        sha256: Of its arrays, in their order.
    """

    voxels: NotNegative
    sha256: Digest


class PlaceTable(Config, frozen=True):
    """The places that the map is found again by (``localization.places``).

    Args:
        places: How many.
        features: Of all of them.
        cameras: Names of the cameras that have seen them.
        sha256: Of its arrays, in their order.
    """

    places: NotNegative
    features: NotNegative
    cameras: tuple[str, ...]
    sha256: Digest


class MapManifest(Config, frozen=True, kw_only=True):
    """What is known of a saved map without reading its blocks.

    Args:
        format, version: Of the file.
        config, label_set: Of the map.
        frames: Frames fused so far.
        last_stamp_ns: Stamp of the last of them, 0 before the first.
        blocks: Blocks of 8^3 voxels.
        bounds_m: Lowest and highest corner of all blocks, metres in the world; None of an empty map.
        chunks: In the order of the file.
        scale: Whether lengths are metres; not written where they are, so older releases read such maps.
        refined: Digest of the weights that refined the map; empty, and not written, where none did.
        instances: Which voxels belong to which thing, of maps that were refined so; not written for others.
        places: What it is found again by; not written when empty.
    """

    format: str = FORMAT
    version: int = FORMAT_VERSION
    config: VoxelMapConfig
    label_set: LabelSet
    frames: NotNegative
    last_stamp_ns: Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
    blocks: NotNegative = 0
    bounds_m: tuple[Corner, Corner] | None = None
    chunks: tuple[MapChunk, ...] = ()
    scale: Literal["metres", "unknown"] = "metres"
    refined: Digest | Literal[""] = ""
    instances: InstanceTable | None = None
    places: PlaceTable | None = None

    @property
    def scale_known(self) -> bool:
        """Whether lengths are metres."""
        return self.scale != SCALE_UNKNOWN


def encode_manifest(manifest: MapManifest) -> bytes:
    """JSON that is the same for the same map."""
    plain: dict[str, Any] = msgspec.to_builtins(manifest)
    if manifest.scale_known:
        del plain["scale"]
    if not manifest.refined:
        del plain["refined"]
    if manifest.instances is None:
        del plain["instances"]
    if manifest.places is None:
        del plain["places"]
    return msgspec.json.format(msgspec.json.encode(plain), indent=1)


def parse_manifest(content: bytes, where: str) -> MapManifest:
    """Read a manifest and check it.

    Raises:
        MapError: it is not one, of another format version, or says what cannot be.
    """
    plain = _plain(content, where)
    try:
        manifest = convert_config(plain, MapManifest, where)
    except ConfigError as error:
        raise MapError(f"{error}. {MEND}") from error
    if manifest.blocks != sum(chunk.blocks for chunk in manifest.chunks):
        raise MapError(f"{where}: its chunks do not hold {manifest.blocks} blocks. {MEND}")
    if manifest.blocks > manifest.config.max_blocks:
        raise MapError(f"{where}: {manifest.blocks} blocks, but max_blocks {manifest.config.max_blocks}. {MEND}")
    for n, chunk in enumerate(manifest.chunks):
        if max(chunk.measured, chunk.voted) > chunk.blocks * BLOCK_VOXELS:
            raise MapError(f"{where}: chunk {n} has more voxels than its {chunk.blocks} blocks can hold. {MEND}")
    return manifest


def digest(content: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(content).hexdigest()


def _plain(content: bytes, where: str) -> dict[str, Any]:
    try:
        plain = msgspec.json.decode(content, type=dict[str, Any])
        kind, version = plain["format"], plain["version"]
    except (msgspec.DecodeError, KeyError, ValueError, RecursionError) as error:
        raise MapError(f"{where}: not a map file: cannot be read ({error}). {MEND}") from error
    if kind != FORMAT:
        raise MapError(f"{where}: not a voxel map but '{kind}'")
    if version != FORMAT_VERSION:
        raise MapError(
            f"{where}: map format {version}, this version reads format {FORMAT_VERSION}; make the map again from its "
            "log with `semantic-mapper replay`, or read it with the version of semantic-mapper that wrote it"
        )
    return plain
