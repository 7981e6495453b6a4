"""Maps merged into tiles: what all tiles hold together is the merged map, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import invert_pose
from semantic_mapper.localization.places import Place
from semantic_mapper.mapping.files.map_file import describe_map, open_map
from semantic_mapper.mapping.files.tiles import (
    TILES_NAME,
    TileManifest,
    cut_map,
    encode_tiles,
    fuse_pieces,
    inside,
    load_tiles,
    load_to_cut,
    merged_header,
    parse_tiles,
    read_tiles,
    write_piece,
)
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64
from tests.mapping.files.test_merge import fuse_views, turned
from tests.mapping.files.tiled import make_tiles
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import same

WHOLE_VOXELS = turned((0, 0, 0), (0.26, -0.06, 0.80))
QUARTER = turned((0, 0, 90), (0.1, 0.0, -0.06))
FREE = turned((20, -35, 50), (0.31, -1.27, 0.553))
Make = Callable[..., VoxelMap]


def saved(folder: Path, make: Make = small_map, poses: tuple[Float64, ...] = (FREE,)) -> list[Path]:
    """Three maps of the sphere, each in a world of its own but the first."""
    paths = []
    for number, T_world_map in enumerate((np.eye(4), *poses)):
        views = range(number * 3, number * 3 + 3)
        paths.append(folder / f"{number}.npz")
        fuse_views(make(), views, invert_pose(T_world_map)).save(paths[-1])
    return paths


@pytest.mark.parametrize(
    ("make", "edge"),
    [
        (small_map, 5),
        (partial(small_map, evidence="int16"), 3),
        (partial(small_map, max_weight=2), 3),
        (partial(small_map, voxel_size_m=0.08), 1),  # a block is a tile
    ],
)
def test_all_tiles_together_are_the_merged_map_bit_for_bit(tmp_path: Path, make: Make, edge: int) -> None:
    poses = (WHOLE_VOXELS, QUARTER, FREE)
    paths = saved(tmp_path, make, poses)
    whole = VoxelMap.load(paths[0])
    for path, T_world_map in zip(paths[1:], poses, strict=True):
        whole = whole.merged(VoxelMap.load(path), T_world_map)
    manifest = make_tiles(paths, (np.eye(4), *poses), tmp_path / "store", edge)
    assert len(manifest.tiles) > 1
    together = load_tiles(manifest, iter(tmp_path / "store" / row.file for row in manifest.tiles))
    assert same(together.block_state(), whole.block_state())
    assert manifest.blocks == whole.block_count == together.block_count
    for name in ("frames", "last_stamp_ns", "scale_known", "version", "config", "label_set"):
        assert getattr(together, name) == getattr(whole, name), name


def test_a_tile_holds_its_border_as_its_neighbours_have_it(tmp_path: Path) -> None:
    edge = 3
    manifest = make_tiles(saved(tmp_path), (np.eye(4), FREE), tmp_path / "store", edge)
    files = [tmp_path / "store" / row.file for row in manifest.tiles]
    whole = load_tiles(manifest, iter(files))
    everything = whole.block_state()
    packed = pack_keys(everything["keys"].astype(np.int32))
    borders = 0
    for row, file in zip(manifest.tiles, files, strict=True):
        state = VoxelMap.load(file).block_state()
        keys = state["keys"].astype(np.int32)
        low = np.array(row.index) * edge
        around = ((everything["keys"] >= low - 1) & (everything["keys"] <= low + edge)).all(axis=1)
        np.testing.assert_array_equal(pack_keys(keys), packed[around])
        assert same(state, {name: values[around] for name, values in everything.items()})
        assert inside(keys, row.index, edge).sum() == row.blocks
        borders += len(keys) - row.blocks
    assert borders > 0


def test_a_map_that_is_paged_to_disk_is_cut_into_the_same_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.npz"
    fuse_views(small_map(voxel_size_m=0.01), range(12)).save(path)
    written: list[list[bytes]] = []
    for memory_mb in (1000, 4):
        monkeypatch.setattr("semantic_mapper.mapping.files.tiles.MEMORY_MB", memory_mb)
        voxel_map = load_to_cut(path)
        assert bool(voxel_map.stored_blocks) == (memory_mb == 4)
        pieces: list[bytes] = []
        for piece in cut_map(voxel_map, FREE, 6):
            file = tmp_path / "piece.npz"
            if write_piece(file, piece, voxel_map, 6):
                with open_map(file) as reader:
                    parts = b"".join(
                        k.tobytes() + b"".join(v.tobytes() for v in values) for k, values in reader.parts()
                    )
                pieces.append(np.array(piece.index).tobytes() + parts)
        written.append(pieces)
    assert written[0] == written[1] and len(written[0]) > 1


def test_the_order_of_pieces_decides_as_the_order_of_maps_does(tmp_path: Path) -> None:
    paths = saved(tmp_path)
    a = make_tiles(paths, (np.eye(4), FREE), tmp_path / "a", 4)
    again = make_tiles(paths, (np.eye(4), FREE), tmp_path / "b", 4)
    assert encode_tiles(a) == encode_tiles(again)
    for row in a.tiles:
        assert (tmp_path / "a" / row.file).read_bytes() == (tmp_path / "b" / row.file).read_bytes()


def test_maps_that_do_not_fit_are_refused_by_name(tmp_path: Path) -> None:
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    fuse_views(small_map(), range(2)).save(paths[0])
    fuse_views(small_map(voxel_size_m=0.04), range(2, 4)).save(paths[1])
    headers = [describe_map(path) for path in paths]
    with pytest.raises(MapError, match=r"b\.npz, beside a\.npz: maps of different voxel_map\.voxel_size_m"):
        merged_header(headers, ["a.npz", "b.npz"])
    with pytest.raises(MapError, match="a and c are the same map"):
        merged_header([headers[0], headers[0]], ["a", "c"])
    with pytest.raises(MapError, match="the scale of the other is unknown"):
        merged_header([headers[0], replace(headers[0], scale="unknown")], ["a", "c"])


def test_a_map_too_large_for_memory_is_not_loaded_whole(tmp_path: Path) -> None:
    manifest = make_tiles(saved(tmp_path), (np.eye(4), FREE), tmp_path / "store", 4)
    tight = replace(manifest, config=replace(manifest.config, max_blocks=manifest.blocks - 1))
    with pytest.raises(MapError, match=r"more than one map may have .*ask `query` for info, at, nearest"):
        load_tiles(tight, iter(()))


@pytest.fixture
def manifest(tmp_path: Path) -> TileManifest:
    return make_tiles(saved(tmp_path), (np.eye(4), FREE), tmp_path / "store", 4)


def test_a_manifest_is_read_as_it_was_written(tmp_path: Path, manifest: TileManifest) -> None:
    assert read_tiles(tmp_path / "store") == manifest
    with pytest.raises(MapError, match="cannot be read"):
        read_tiles(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ((b'"format": "semantic-mapper tiles"', b'"format": "zarr"'), "no manifest of tiles but of 'zarr'"),
        ((b'"version": 2', b'"version": 1'), "tiles of version 1"),
        ((b'"tiles/', b'"../tiles/'), "file"),
        ((b'"edge_blocks": 4', b'"edge_blocks": 0'), "edge_blocks"),
        ((b'"edge_blocks": 4', b'"edge": 4'), "edge"),
        ((b"{", b""), "cannot be read"),
    ],
)
def test_a_damaged_manifest_is_refused(
    tmp_path: Path, manifest: TileManifest, change: tuple[bytes, bytes], says: str
) -> None:
    content = (tmp_path / "store" / TILES_NAME).read_bytes()
    assert change[0] in content
    with pytest.raises(MapError, match=says):
        parse_tiles(content.replace(*change, 1), "here")


def test_tiles_that_come_twice_are_refused(manifest: TileManifest) -> None:
    twice = replace(manifest, tiles=(manifest.tiles[0], *manifest.tiles))
    with pytest.raises(MapError, match="come twice"):
        parse_tiles(encode_tiles(twice), "here")


def test_a_place_goes_to_the_tile_in_which_most_of_its_features_lie(tmp_path: Path) -> None:
    paths = saved(tmp_path)
    second = VoxelMap.load(paths[1])
    surface = second.points().xyz
    east = surface[surface[:, 0] > np.median(surface[:, 0])]
    place = Place("test", 5, np.eye(4), east.astype(np.float32), np.ones((len(east), 128), np.uint8))
    second.places.add(place)
    second.save(paths[1])
    manifest = make_tiles(paths, (np.eye(4), FREE), tmp_path / "store", 2)
    world = east @ FREE[:3, :3].T + FREE[:3, 3]
    tiles = np.floor(world / (2 * 8 * 0.02)).astype(int)
    distinct, counts = np.unique(tiles, axis=0, return_counts=True)
    holders = [r for r in manifest.tiles if len(VoxelMap.load(tmp_path / "store" / r.file).places)]
    assert [row.index for row in holders] == [tuple(distinct[counts.argmax()].tolist())]
    whole = load_tiles(manifest, iter(tmp_path / "store" / row.file for row in manifest.tiles))
    (kept,) = whole.places.places
    np.testing.assert_allclose(kept.T_world_camera, FREE)


def test_a_missing_piece_is_reported(tmp_path: Path) -> None:
    header = merged_header([describe_map(p) for p in saved(tmp_path)], ["a", "b"])
    with pytest.raises(MapError, match="no such map file"):
        fuse_pieces([tmp_path / "missing.npz"], header)
