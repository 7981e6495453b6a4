"""A map in tiles: many maps of one building, merged into files of bounded size, and a manifest that names them.

A tile is a cube of ``edge_blocks`` blocks a side. Its file is a map file (``map_file``) of the blocks in the cube and
of its border, the blocks that touch it, so that its surface has no seam and can be read without its neighbours. A block
counts where it is inside: borders repeat blocks of other tiles, bit for bit.

Maps become tiles in two steps, which may run in any order, on any machine. Each map is cut, moved to the common world,
into pieces, one for each tile that it reaches (``cut_map``). The pieces of each tile are added in the order of the maps
(``fuse_pieces``). All tiles together are what ``VoxelMap.merged`` makes of the same maps, bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from semantic_mapper.config import AtLeastOne, Config, NotNegative, VoxelMapConfig, convert_config
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.localization.places import Place, moved_place
from semantic_mapper.mapping.files.map_file import BlockPart, describe_map, open_map, write_map
from semantic_mapper.mapping.files.map_manifest import Digest, MapManifest, digest
from semantic_mapper.mapping.files.merge import add_values, check_fit, moved_blocks, overlaps, voxel_transform
from semantic_mapper.mapping.map_scale import require_same_scale
from semantic_mapper.mapping.storage.block_index import pack_keys, unpack_keys
from semantic_mapper.mapping.storage.grid_buffers import BLOCK_SIDE
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.types import Bool, Float64, Int64

TILES_NAME = "tiles.json"
TILES_FORMAT = "semantic-mapper tiles"
TILES_VERSION = 2  # 1 had no digests
EDGE_BLOCKS = 25  # 4 m at 2 cm voxels: about 5000 blocks of a furnished building, 0.2 GB of memory with 13 classes
MEMORY_MB = 1000  # of a map that is cut; what is used longest ago goes to disk (``voxel_map.memory_mb``)
_MAX_MANIFEST_BYTES = 64 << 20
_MEND = "Use another copy, or merge the maps again into another store"

TileIndex = tuple[int, int, int]
Corner = tuple[float, float, float]
Rows = tuple[tuple[float, float, float, float], ...]


class ClassExtent(Config, frozen=True):
    """The surface of one class in a tile.

    Args:
        voxels: Surface voxels.
        most_sure: Greatest confidence among them, 0..1.
        lower, upper: Corners of the box round their surface points, in voxels of the world.
    """

    voxels: AtLeastOne
    most_sure: float
    lower: Corner
    upper: Corner


class TileSurface(Config, frozen=True):
    """The surface in a tile, without its border.

    Args:
        voxels: Surface voxels.
        measured: Those of them that a sensor measured.
        without_class: Those of them without a class.
        lower, upper: Corners of the box round their surface points, in voxels of the world; None = no surface.
        classes: By the name of the class; classes without surface are left out.
    """

    voxels: NotNegative = 0
    measured: NotNegative = 0
    without_class: NotNegative = 0
    lower: Corner | None = None
    upper: Corner | None = None
    classes: dict[str, ClassExtent] = msgspec.field(default_factory=dict)


class TileRow(Config, frozen=True):
    """One tile.

    Args:
        index: Its blocks have coordinates from ``index * edge_blocks`` on.
        file: Name below the folder of the manifest.
        digest: Of its file (``MapReader.digest``); empty where there is none, as all blocks are of the border.
        blocks: Inside the tile; its file holds those of the border, too.
        surface: See there.
    """

    index: TileIndex
    file: Annotated[str, msgspec.Meta(pattern=r"^tiles/[0-9a-f_-]+\.npz$")]
    digest: Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{64}|)\Z")]
    blocks: NotNegative
    surface: TileSurface


class TileSource(Config, frozen=True):
    """One of the maps that were merged.

    Args:
        name: As it was given.
        digest: Of its content.
        frames: Fused into it.
        T_world_map: (4, 4), where it lies.
        placed: "first" = its world is that of the merged map; "given"; or "found" by what the maps show.
    """

    name: str
    digest: Digest
    frames: NotNegative
    T_world_map: Rows
    placed: Literal["first", "given", "found"]


class TileManifest(Config, frozen=True, kw_only=True):
    """What is known of a map in tiles without reading them.

    Args:
        format, version: Of the manifest.
        plan: Digest of all that decides the tiles: content and places of the maps, and the edge.
        config, label_set: Of the merged map: those of the first map.
        edge_blocks: Edge of a tile.
        frames, last_stamp_ns, refined, scale: As in ``MapManifest``.
        sources: The maps, in the order in which they were added.
        tiles: By ascending index.
    """

    format: str = TILES_FORMAT
    version: int = TILES_VERSION
    plan: Digest
    config: VoxelMapConfig
    label_set: LabelSet
    edge_blocks: AtLeastOne
    frames: NotNegative
    last_stamp_ns: int
    refined: str = ""
    scale: Literal["metres", "unknown"] = "metres"
    sources: tuple[TileSource, ...]
    tiles: tuple[TileRow, ...]

    @property
    def scale_known(self) -> bool:
        """Whether lengths are metres."""
        return self.scale != SCALE_UNKNOWN

    @property
    def blocks(self) -> int:
        """Of all tiles."""
        return sum(tile.blocks for tile in self.tiles)


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """What one map says of one tile and its border.

    Args:
        index: Of the tile.
        parts: Its blocks in lexicographic order, as ``moved_blocks`` gives them; may be gone through once.
        places: Views whose features lie in the tile, in the common world.
    """

    index: TileIndex
    parts: Iterator[BlockPart]
    places: tuple[Place, ...]


def inside(keys: NDArray[np.integer], index: TileIndex, edge_blocks: int) -> Bool:
    """Which blocks (B, 3) are inside a tile rather than in its border."""
    return (np.floor_divide(keys, edge_blocks) == np.array(index)).all(axis=1)


def merged_header(headers: Sequence[MapManifest], names: Sequence[str]) -> MapManifest:
    """What the merged map says of itself: settings of the first map, frames of all.

    Args:
        headers: Of the maps, in their order.
        names: Of the maps, for errors.

    Raises:
        MapError: maps of other voxels or classes, the same map twice, or lengths in metres in some of them only.
    """
    first = headers[0]
    seen: dict[str, str] = {}
    for header, name in zip(headers, names, strict=True):
        try:
            check_fit(first.config, first.label_set, header.config, header.label_set)
            require_same_scale(first.scale_known, header.scale_known, "merge")
        except MapError as error:
            raise MapError(f"{name}, beside {names[0]}: {error}") from error
        if header.chunks and (twin := seen.setdefault(content_digest(header), name)) is not name:
            raise MapError(f"{twin} and {name} are the same map: all that it has seen would count twice")
    return replace(
        first,
        frames=sum(header.frames for header in headers),
        last_stamp_ns=max(header.last_stamp_ns for header in headers),
        refined=next((header.refined for header in headers if header.refined), ""),
        blocks=0,
        bounds_m=None,
        chunks=(),
        instances=None,
        places=None,
    )


def content_digest(header: MapManifest) -> str:
    """Digest of a saved map: its manifest holds those of its chunks."""
    return digest(msgspec.json.encode(header))


def tile_digest(path: Path) -> str:
    """Digest of a tile's file, for its row in the manifest.

    Raises:
        MapError: see ``open_map``.
    """
    with open_map(path) as reader:
        return reader.digest


def check_tile(row: TileRow, digest: str) -> None:
    """Check that a file is the one that the manifest means: tiles are maps, and each could stand in another's place.

    Args:
        row: Of the manifest.
        digest: Of the file.

    Raises:
        MapError: it is another one; names it.
    """
    if digest != row.digest:
        raise MapError(
            f"{row.file}: is another map than the manifest of the tiles names so: it was exchanged, or is of another "
            "merge. `fleet merge` of the same maps into the same store makes it again"
        )


def load_to_cut(path: Path) -> VoxelMap:
    """A saved map in bounded memory (``MEMORY_MB``).

    Raises:
        MapError: see ``VoxelMap.load``.
    """
    saved_mb = describe_map(path).config.memory_mb
    return VoxelMap.load(path, memory_mb=min(saved_mb or MEMORY_MB, MEMORY_MB))


def cut_map(voxel_map: VoxelMap, T_world_map: Float64, edge_blocks: int) -> Iterator[Piece]:
    """Cut a map, moved to a common world, into the pieces of tiles.

    Args:
        voxel_map: Is read; nobody may change it meanwhile.
        T_world_map: (4, 4) float64.
        edge_blocks: Of the tiles.

    Yields:
        Pieces by ascending index of their tiles. Go through the blocks of each before the next one.
    """
    transform = voxel_transform(T_world_map, voxel_map.config.voxel_size_m)
    with voxel_map.locked() as grid:
        pairs = overlaps(pack_keys(grid.all_keys()), transform)
    rows, tile = _tiles_of(unpack_keys(pairs[:, 0]), edge_blocks)
    tiles, starts = np.unique(tile, return_index=True)
    indices = unpack_keys(tiles)
    places = _places_by_tile([moved_place(p, T_world_map) for p in voxel_map.places.places], voxel_map, edge_blocks)
    for number, (start, end) in enumerate(zip(starts, [*starts[1:], len(rows)], strict=True)):
        x, y, z = indices[number].tolist()
        index: TileIndex = (x, y, z)

        def parts(pairs: Int64 = pairs[rows[start:end]]) -> Iterator[BlockPart]:
            with voxel_map.locked() as grid:
                for packed, values in moved_blocks(grid, transform, pairs):
                    yield unpack_keys(packed), values

        yield Piece(index, parts(), tuple(places.get(index, ())))


def write_piece(path: Path, piece: Piece, voxel_map: VoxelMap, edge_blocks: int) -> bool:
    """Write a piece as a map file; False, and no file, where the map has measured nothing there.

    Args:
        path: Of the file.
        piece: Of ``cut_map``.
        voxel_map: That it was cut from.
        edge_blocks: Of the tiles.

    Raises:
        MapError: the file cannot be written.
    """
    most = max(voxel_map.config.max_blocks, (edge_blocks + 2) ** 3)
    config = replace(voxel_map.config, evidence="float32", max_blocks=most)  # sums, whatever the map holds
    header = MapManifest(
        config=config,
        label_set=voxel_map.label_set,
        frames=voxel_map.frames,
        last_stamp_ns=voxel_map.last_stamp_ns,
    )
    first = next(piece.parts, None)
    if first is None:
        return False
    write_map(path, header, _with_first(first, piece.parts), None, piece.places)
    return True


def fuse_pieces(pieces: Sequence[Path], header: MapManifest) -> VoxelMap:
    """One tile, with its border, of its pieces.

    Args:
        pieces: Files of ``write_piece``, in the order of the maps.
        header: Of the merged map (``merged_header``).

    Raises:
        MapError: a piece is damaged, or the tile has more than ``voxel_map.max_blocks``.
    """
    tile = VoxelMap(header.config, header.label_set)
    tile.note_scale(header.scale_known)
    tile.refined = header.refined
    tile.frames = tile.version = header.frames
    tile.last_stamp_ns = header.last_stamp_ns
    for path in pieces:
        with open_map(path) as reader:
            for keys, values in reader.parts():
                with tile.locked() as grid:
                    add_values(grid, pack_keys(keys), values, header.config.max_weight, header.frames)
            for place in reader.places():
                tile.places.add(place)
    return tile


def load_tiles(manifest: TileManifest, files: Iterator[Path]) -> VoxelMap:
    """The whole merged map, in memory.

    Args:
        manifest: Of the tiles.
        files: Of the tiles, in the order of the manifest.

    Raises:
        MapError: it has more blocks than one map may (``voxel_map.max_blocks``), or a tile is damaged.
    """
    if manifest.blocks > manifest.config.max_blocks:
        raise MapError(
            f"{manifest.blocks} blocks of {len(manifest.tiles)} tiles are more than one map may have "
            f"(voxel_map.max_blocks = {manifest.config.max_blocks}): ask `query` for info, at, nearest or instances, "
            "which need no whole map, or take the files of single tiles"
        )
    whole = VoxelMap(manifest.config, manifest.label_set)
    whole.note_scale(manifest.scale_known)
    whole.refined = manifest.refined
    whole.frames = whole.version = manifest.frames
    whole.last_stamp_ns = manifest.last_stamp_ns
    for row, path in zip(manifest.tiles, files, strict=True):
        with open_map(path) as reader:
            check_tile(row, reader.digest)
            for keys, values in reader.parts():
                own = inside(keys, row.index, manifest.edge_blocks)
                with whole.locked() as grid:
                    blocks = grid.fill(pack_keys(keys[own]), type(values)(*(part[own] for part in values)))
                    grid.mark_changed(blocks, manifest.frames)
            for place in reader.places():
                whole.places.add(place)
    return whole


def encode_tiles(manifest: TileManifest) -> bytes:
    """JSON that is the same for the same tiles."""
    return msgspec.json.format(msgspec.json.encode(manifest), indent=1)


def parse_tiles(content: bytes, where: str) -> TileManifest:
    """Read a manifest and check it.

    Raises:
        MapError: it is not one, of a newer version, or says what cannot be.
    """
    try:
        plain: dict[str, Any] = msgspec.json.decode(content, type=dict[str, Any])
        kind, version = plain["format"], plain["version"]
    except (msgspec.DecodeError, KeyError, ValueError, RecursionError) as error:
        raise MapError(f"{where}: no manifest of tiles: cannot be read ({error}). {_MEND}") from error
    if kind != TILES_FORMAT:
        raise MapError(f"{where}: no manifest of tiles but of '{kind}'")
    if version != TILES_VERSION:
        raise MapError(
            f"{where}: tiles of version {version}, this release reads version {TILES_VERSION}; merge "
            "again into another store"
        )
    try:
        manifest = convert_config(plain, TileManifest, where)
    except ConfigError as error:
        raise MapError(f"{error}. {_MEND}") from error
    for tile in manifest.tiles:
        if not tile.digest:
            raise MapError(f"{where}: has no digest of {tile.file}. {_MEND}")
    indices = [tile.index for tile in manifest.tiles]
    if indices != sorted(set(indices)):
        raise MapError(f"{where}: tiles are not in order, or come twice. {_MEND}")
    return manifest


def read_tiles(folder: Path) -> TileManifest:
    """The manifest of the tiles in a folder.

    Raises:
        MapError: it is missing or damaged; see ``parse_tiles``.
    """
    path = folder / TILES_NAME
    try:
        content = read_regular(path, _MAX_MANIFEST_BYTES)
    except (OSError, ConfigError) as error:
        raise MapError(f"{path}: cannot be read: {error}") from error
    return parse_tiles(content, str(path))


def write_tiles(folder: Path, manifest: TileManifest) -> None:
    """Write the manifest of tiles whose files are in the folder.

    Raises:
        MapError: it cannot be written.
    """
    write_bytes(folder / TILES_NAME, encode_tiles(manifest), sync="folder", raises=MapError)


def _tiles_of(keys: NDArray[np.int32], edge_blocks: int) -> tuple[Int64, Int64]:
    """Rows (M,) of blocks (B, 3), and packed index (M,) of a tile that has them inside or in its border.

    Sorted by tile, then by row: a block at a face, edge or corner of its tile comes up to 8 times.
    """
    own = np.floor_divide(keys, edge_blocks)
    within = keys - own * edge_blocks
    rows: list[Int64] = []
    tiles: list[Int64] = []
    for step in np.ndindex(3, 3, 3):
        offset = np.array(step) - 1
        at_face = np.where(offset < 0, within == 0, within == edge_blocks - 1) | (offset == 0)
        there = np.flatnonzero(at_face.all(axis=1))
        rows.append(there)
        tiles.append(pack_keys((own[there] + offset).astype(np.int32)))
    joined_rows, joined_tiles = np.concatenate(rows), np.concatenate(tiles)
    order = np.lexsort((joined_rows, joined_tiles))
    return joined_rows[order], joined_tiles[order]


def _places_by_tile(places: Sequence[Place], voxel_map: VoxelMap, edge_blocks: int) -> dict[TileIndex, list[Place]]:
    """Each place goes to the tile in which most of its features lie: there is the surface that it shows."""
    found: dict[TileIndex, list[Place]] = {}
    edge_m = edge_blocks * BLOCK_SIDE * voxel_map.config.voxel_size_m
    for place in places:
        if not len(place.points):
            continue
        T = place.T_world_camera
        tiles = np.floor((place.points @ T[:3, :3].T + T[:3, 3]) / edge_m).astype(np.int64)
        distinct, counts = np.unique(tiles, axis=0, return_counts=True)
        x, y, z = distinct[counts.argmax()].tolist()
        found.setdefault((x, y, z), []).append(place)
    return found


def _with_first(first: BlockPart, others: Iterator[BlockPart]) -> Iterator[BlockPart]:
    yield first
    yield from others
