"""Queries on tiles against the same queries on the whole map; which tiles they load."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from semantic_mapper.errors import LabelError, MapError
from semantic_mapper.mapping.files.tiles import TileManifest
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries import tiles as tiles_module
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import at, nearest
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import surface_points, surface_voxels
from semantic_mapper.queries.tiles import TiledMap
from tests.mapping.files.tiled import make_tiles
from tests.mapping.rendered_views import small_map
from tests.queries.scene import BALL, BOX, HALF, LABELS, RADIUS, integrate, poses

EDGE = 4  # 0.64 m: table and ball reach over several tiles


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that saw the known scene from two sides, in tiles, and the whole map beside them."""
    folder = tmp_path_factory.mktemp("store")
    paths = [folder / "a.npz", folder / "b.npz"]
    views = poses(14)
    for path, part in zip(paths, (range(8), range(8, 14)), strict=True):
        voxel_map = small_map(LABELS)
        for seq in part:
            integrate(voxel_map, views[seq], seq)
        voxel_map.save(path)
    manifest = make_tiles(paths, (np.eye(4), np.eye(4)), folder, EDGE)
    assert len(manifest.tiles) > 20
    VoxelMap.load(paths[0]).merged(VoxelMap.load(paths[1]), np.eye(4)).save(folder / "whole.npz")
    return folder


@pytest.fixture(scope="module")
def snapshot(folder: Path) -> MapSnapshot:
    return MapMirror.of(VoxelMap.load(folder / "whole.npz")).snapshot()


@pytest.fixture
def tiled(folder: Path) -> TiledMap:
    return TiledMap.open(folder)


def test_nearest_is_that_of_the_whole_map(tiled: TiledMap, snapshot: MapSnapshot) -> None:
    rng = np.random.default_rng(0)
    for point in rng.uniform((-2.5, -2.5, -0.5), (2.5, 2.5, 1.5), (60, 3)):
        for name in ("floor", "table", "cup"):
            for least in (0.0, 0.9):
                found, expected = tiled.nearest(name, point, least), nearest(snapshot, name, point, least)
                assert (found is None) == (expected is None)
                if found is not None and expected is not None:
                    assert found.xyz.tolist() == expected.xyz.tolist()
                    assert (found.distance_m, found.confidence, found.measured) == (
                        expected.distance_m,
                        expected.confidence,
                        expected.measured,
                    )


def test_nearest_loads_only_tiles_that_can_be_nearer(folder: Path, tiled: TiledMap) -> None:
    assert tiled.nearest("lamp", (0, 0, 0)) is None and tiled.loads == 0
    assert tiled.nearest("cup", (0, 0, 0), min_confidence=1.0) is None
    assert tiled.loads == 0, "no tile is so sure"
    above = BALL + np.array([0.0, 0.0, RADIUS + 0.05])
    hit = tiled.nearest("cup", above)
    assert hit is not None and abs(hit.distance_m - 0.05) < 0.01
    loaded = tiled.loads
    of_cup = sum("cup" in row.surface.classes for row in tiled.manifest.tiles)
    assert 1 <= loaded < of_cup < len(tiled.manifest.tiles)
    tiled.nearest("cup", above)
    assert tiled.loads == loaded, "they are in memory still"


def test_no_more_tiles_than_allowed_are_in_memory(folder: Path) -> None:
    manifest = TiledMap.open(folder).manifest
    tiled = TiledMap(manifest, lambda row: nullcontext(folder / row.file), cached=2)
    for _ in range(2):
        for point in ((-1.5, 0.0, 0.0), (1.5, 0.0, 0.0), (0.0, 1.5, 0.0)):
            tiled.nearest("floor", point)
            assert len(tiled._tiles) <= 2
    assert tiled.loads == 6, "each comes back when it has left memory"
    tiled.instances()
    assert len(tiled._tiles) <= 2


def test_at_is_that_of_the_whole_map_across_borders_too(tiled: TiledMap, snapshot: MapSnapshot) -> None:
    rng = np.random.default_rng(1)
    border = EDGE * 8 * 0.02
    near = rng.uniform((-2, -2, -0.05), (2, 2, 0.45), (150, 3))
    near[:50, 0] = np.rint(near[:50, 0] / border) * border + rng.uniform(-0.03, 0.03, 50)
    near[::2, 2] = rng.uniform(-0.03, 0.03, 75)
    near[50:80] = BOX + HALF * rng.uniform(-1.05, 1.05, (30, 3))
    for radius in (None, 0.3):
        found, expected = tiled.at(near, radius), at(snapshot, near, radius)
        for name in ("label", "confidence", "distance_m", "state", "measured"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        assert np.isfinite(found.distance_m).mean() > 0.2
    assert len(tiled.at(np.empty((0, 3))).label) == 0


def test_at_loads_the_tiles_round_the_point_alone(tiled: TiledMap) -> None:
    middle = EDGE * 8 * 0.02 / 2
    tiled.at([(middle, middle, middle)])
    assert tiled.loads == 1
    tiled.at([(100.0, 0.0, 0.0)])
    assert tiled.loads == 1
    with pytest.raises(MapError, match="radius_m must be at most"):
        tiled.at([(0, 0, 0)], radius_m=5.0)


def test_instances_join_across_tiles(tiled: TiledMap, snapshot: MapSnapshot) -> None:
    expected = InstanceTracker().update(snapshot)
    found = tiled.instances()
    assert sorted(thing.class_name for thing in found) == ["cup", "table"]
    assert len(found) == len(expected)
    for mine, theirs in zip(found, expected, strict=True):
        assert (mine.id, mine.class_name, mine.confidence, mine.measured) == (
            theirs.id,
            theirs.class_name,
            theirs.confidence,
            theirs.measured,
        )
        for name in ("centroid", "voxels"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        for name in ("center", "size", "R_world_box"):
            np.testing.assert_array_equal(getattr(mine.box, name), getattr(theirs.box, name))
    spread = {tuple(key) for thing in found for key in (thing.voxels // (8 * EDGE)).tolist()}
    assert len(spread) > 4, "the things lie in several tiles"


def test_points_are_those_of_the_whole_map_in_their_order(tiled: TiledMap, snapshot: MapSnapshot) -> None:
    expected = surface_points(snapshot, surface_voxels(snapshot))
    found = tiled.points()
    for name in MapPoints.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_the_manifest_counts_the_surface(tiled: TiledMap, snapshot: MapSnapshot) -> None:
    surface = surface_voxels(snapshot)
    rows = [row.surface for row in tiled.manifest.tiles]
    assert sum(row.voxels for row in rows) == len(surface.row)
    lower = np.min([row.lower for row in rows if row.lower], axis=0)
    np.testing.assert_array_equal(lower, surface.point.min(axis=0))


def test_the_whole_map_comes_back(tiled: TiledMap, folder: Path) -> None:
    whole, again = VoxelMap.load(folder / "whole.npz").block_state(), tiled.load().block_state()
    for name, values in whole.items():
        np.testing.assert_array_equal(values, again[name], err_msg=name)


def test_questions_that_cannot_be_answered(tiled: TiledMap, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LabelError, match="no class 'sofa'"):
        tiled.nearest("sofa", (0, 0, 0))
    with pytest.raises(MapError, match="min_confidence"):
        tiled.nearest("cup", (0, 0, 0), 1.5)
    monkeypatch.setattr(tiles_module, "MAX_SURFACE", 100)
    with pytest.raises(MapError, match="more than are held in memory"):
        tiled.instances()
    with pytest.raises(MapError, match="single tiles"):
        tiled.points()
    assert tiled.loads == 0


def test_a_map_without_metres_is_not_asked_in_metres(folder: Path, tiled: TiledMap) -> None:
    unknown = TiledMap(replace(tiled.manifest, scale="unknown"), lambda row: nullcontext(folder / row.file))
    for question in (
        lambda: unknown.nearest("cup", (0, 0, 0)),
        lambda: unknown.at([(0, 0, 0)]),
        lambda: unknown.instances(),
    ):
        with pytest.raises(MapError, match="scale is unknown"):
            question()


def test_nothing_is_found_in_no_tiles(tiled: TiledMap) -> None:
    empty: TileManifest = replace(tiled.manifest, tiles=())
    nothing = TiledMap(empty, lambda row: nullcontext(Path(row.file)))
    assert nothing.nearest("cup", (0, 0, 0)) is None
    assert nothing.at([(0, 0, 0)]).label.tolist() == [LABELS.ignore_id]
    assert nothing.instances() == () and len(nothing.points().xyz) == 0
    assert nothing.load().block_count == 0
