"""Maps merged into tiles one step after the other, in one process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semantic_mapper.mapping.files.map_file import describe_map
from semantic_mapper.mapping.files.tiles import (
    TileIndex,
    TileManifest,
    TileRow,
    content_digest,
    cut_map,
    fuse_pieces,
    load_to_cut,
    merged_header,
    tile_digest,
    write_piece,
    write_tiles,
)
from semantic_mapper.queries.tiles import describe_tile
from semantic_mapper.types import Float64


def make_tiles(maps: Sequence[Path], poses: Sequence[Float64], folder: Path, edge_blocks: int) -> TileManifest:
    """Merge saved maps into tiles below a folder."""
    headers = [describe_map(path) for path in maps]
    header = merged_header(headers, [str(path) for path in maps])
    pieces: dict[TileIndex, list[Path]] = {}
    (folder / "pieces").mkdir(parents=True)
    (folder / "tiles").mkdir()
    for number, (path, T_world_map) in enumerate(zip(maps, poses, strict=True)):
        voxel_map = load_to_cut(path)
        for piece in cut_map(voxel_map, T_world_map, edge_blocks):
            file = folder / "pieces" / f"{number}-{'_'.join(map(str, piece.index))}.npz"
            if write_piece(file, piece, voxel_map, edge_blocks):
                pieces.setdefault(piece.index, []).append(file)
    rows: list[TileRow] = []
    for index, files in sorted(pieces.items()):
        tile = fuse_pieces(files, header)
        blocks, surface = describe_tile(tile, index, edge_blocks)
        if blocks:
            name = f"tiles/{'_'.join(map(str, index))}.npz"
            tile.save(folder / name)
            digest = tile_digest(folder / name)
            rows.append(TileRow(index=index, file=name, digest=digest, blocks=blocks, surface=surface))
    manifest = TileManifest(
        plan=content_digest(header),
        config=header.config,
        label_set=header.label_set,
        edge_blocks=edge_blocks,
        frames=header.frames,
        last_stamp_ns=header.last_stamp_ns,
        refined=header.refined,
        scale=header.scale,
        sources=(),
        tiles=tuple(rows),
    )
    write_tiles(folder, manifest)
    return manifest
