from __future__ import annotations

import hashlib
import json
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.map_file import describe_map
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.rendered_views import LABELS, around, frame, small_map, sphere_depth, sure
from tests.mapping.test_voxel_map import CENTER, fuse_sphere, same


@pytest.fixture
def saved(tmp_path: Path) -> tuple[VoxelMap, Path]:
    voxel_map = small_map(voxel_size_m=0.03)
    fuse_sphere(voxel_map, 3)
    path = tmp_path / "map.npz"
    voxel_map.save(path)
    return voxel_map, path


def one_more(voxel_map: VoxelMap) -> None:
    pose = around(CENTER, 1.1, 7)[2]
    depth = sphere_depth(pose, CENTER, 0.4)
    voxel_map.integrate(frame(pose, seq=9), depth, sure(2, 0.5), None)


def test_loaded_map_is_the_saved_one_bit_for_bit_and_goes_on(saved: tuple[VoxelMap, Path]) -> None:
    voxel_map, path = saved
    loaded = VoxelMap.load(path)
    assert same(voxel_map.block_state(), loaded.block_state())
    assert (loaded.config, loaded.label_set) == (voxel_map.config, LABELS)
    assert (loaded.frames, loaded.last_stamp_ns) == (3, 1002)
    one_more(voxel_map)
    one_more(loaded)
    assert same(voxel_map.block_state(), loaded.block_state())
    assert (voxel_map.points().label == loaded.points().label).all()


def test_the_same_map_gives_the_same_bytes(saved: tuple[VoxelMap, Path], tmp_path: Path) -> None:
    voxel_map, path = saved
    again = tmp_path / "again.npz"
    VoxelMap.load(path).save(again)
    assert again.read_bytes() == path.read_bytes()
    one_more(voxel_map)
    voxel_map.save(again)
    assert again.read_bytes() != path.read_bytes()


def test_a_map_is_described_without_its_blocks(saved: tuple[VoxelMap, Path]) -> None:
    voxel_map, path = saved
    found = describe_map(path)
    state = voxel_map.block_state()
    corners = np.stack((state["keys"].min(axis=0), state["keys"].max(axis=0) + 1)) * (8 * 0.03)
    assert (found.version, found.frames, found.last_stamp_ns, found.blocks) == (4, 3, 1002, voxel_map.block_count)
    assert (found.config, found.label_set) == (voxel_map.config, LABELS)
    np.testing.assert_allclose(np.array(found.bounds_m), corners, rtol=0, atol=1e-9)
    assert sum(chunk.measured for chunk in found.chunks) == (state["weight"] > 0).sum()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert describe_map(path) == found
    with pytest.raises(MapError, match="chunk 0 of 1"):
        VoxelMap.load(path)


def test_any_flipped_bit_is_found_or_harmless(saved: tuple[VoxelMap, Path], rng: np.random.Generator) -> None:
    voxel_map, path = saved
    good, state = path.read_bytes(), voxel_map.block_state()
    refused = 0
    positions = [*rng.integers(0, len(good), 60), *range(0, 60, 3), *range(len(good) - 1600, len(good), 5)]
    for position in positions:
        bad = bytearray(good)
        bad[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        try:
            loaded = VoxelMap.load(path)
        except MapError:
            refused += 1
        else:
            assert same(loaded.block_state(), state)  # a time stamp of the container, say
    assert refused > 200


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5, 0.99])
def test_truncated_file_is_refused(saved: tuple[VoxelMap, Path], fraction: float) -> None:
    path = saved[1]
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(MapError, match="damaged or not a map"):
        VoxelMap.load(path)
    for lost in (1, 2, 30, 64, 100):
        path.write_bytes(content[:-lost])
        with pytest.raises(MapError, match="damaged"):
            VoxelMap.load(path)


def rewrite(path: Path, change_manifest: dict[str, object], **members: bytes | None) -> None:
    """Change a file with all its checksums; members by array name of chunk 0, None = left out."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    manifest = {**json.loads(content.pop("manifest.json")), **change_manifest}
    content |= {f"000000/{name}.npy": new for name, new in members.items() if new is not None}
    encoded = json.dumps(manifest).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in {**content, "manifest.json": encoded}.items():
            if Path(name).stem not in members or members[Path(name).stem] is not None:
                archive.writestr(name, value)
        archive.comment = b"sha256 of manifest.json: " + hashlib.sha256(encoded).hexdigest().encode()


def test_what_is_wrong_is_named(saved: tuple[VoxelMap, Path]) -> None:
    path = saved[1]
    good = path.read_bytes()
    cases: list[tuple[dict[str, object], str]] = [
        ({"version": 99}, "format 99"),
        ({"version": 1, "arrays": {}}, "map format 1, .*make the map again from its log"),
        ({"format": "cake"}, "cake"),
        ({"label_set": {"name": "x"}}, "manifest.json.*label_set"),
        ({"config": {"voxel_sise_m": 1}}, "voxel_size_m"),
        ({"chunks": []}, "its chunks do not hold 72 blocks"),
        ({"frames": None}, "manifest.json.*frames"),
        ({"frames": -1}, "manifest.json.*frames"),
        ({"config": {"max_blocks": 50}}, "72 blocks, or more than max_blocks"),
    ]
    for change, message in cases:
        path.write_bytes(good)
        rewrite(path, change)
        with pytest.raises(MapError, match=message):
            VoxelMap.load(path)
    path.write_bytes(good)
    rewrite(path, {}, evidence=None)
    with pytest.raises(MapError, match="arrays are missing"):
        VoxelMap.load(path)


def test_what_claims_to_be_huge_is_refused_before_memory_is_taken(saved: tuple[VoxelMap, Path]) -> None:
    path = saved[1]
    good = path.read_bytes()
    chunk = json.loads(zipfile.ZipFile(path).read("manifest.json"))["chunks"][0]
    cases: list[tuple[dict[str, object], dict[str, bytes | None]]] = [
        ({"blocks": 10**15}, {}),
        ({"blocks": 10**9, "chunks": [{**chunk, "blocks": 10**9}]}, {}),
        ({"chunks": [{**chunk, "voted": 10**12}]}, {}),
        ({"chunks": [{**chunk, "voted": 72 * 512 + 1}]}, {}),
        ({}, {"tsdf": bytes(300_000_000)}),
        ({"last_stamp_ns": 10**30}, {}),
        ({"label_set": [[[[]]]] * 1000}, {}),
    ]
    for change, members in cases:
        path.write_bytes(good)
        rewrite(path, change, **members)
        tracemalloc.start()
        with pytest.raises(MapError):
            VoxelMap.load(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20e6


def test_files_that_are_no_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such map"):
        VoxelMap.load(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(MapError, match="not a map file"):
        VoxelMap.load(tmp_path / "other.npz")
    with pytest.raises(MapError, match=r"damaged or not a map"):
        VoxelMap.load(tmp_path)
