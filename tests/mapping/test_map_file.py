from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.test_voxel_map import CENTER, fuse_sphere, same
from tests.mapping.views import LABELS, around, frame, small_map, sphere_depth, sure


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


def test_an_empty_map_survives(tmp_path: Path) -> None:
    small_map().save(tmp_path / "empty.npz")
    loaded = VoxelMap.load(tmp_path / "empty.npz")
    assert loaded.block_count == 0
    one_more(loaded)
    assert loaded.block_count > 0


def test_numpy_opens_the_file_and_no_temporary_stays(saved: tuple[VoxelMap, Path]) -> None:
    voxel_map, path = saved
    with np.load(path) as arrays:
        assert (arrays["keys"] == voxel_map.block_state()["keys"]).all()
    assert [p.name for p in path.parent.iterdir()] == ["map.npz"]


def test_any_flipped_bit_is_found_or_harmless(saved: tuple[VoxelMap, Path], rng: np.random.Generator) -> None:
    voxel_map, path = saved
    good, state = path.read_bytes(), voxel_map.block_state()
    refused = 0
    positions = [*rng.integers(0, len(good), 60), *range(0, 60, 3), *range(len(good) - 120, len(good), 3)]
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
    assert refused > 50


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_truncated_file_is_refused(saved: tuple[VoxelMap, Path], share: float) -> None:
    path = saved[1]
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(MapError, match="damaged or not a map"):
        VoxelMap.load(path)


def rewrite(path: Path, change_manifest: dict[str, object], leave_out: str = "") -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist() if name != leave_out}
    manifest = json.loads(members["manifest.json"])
    manifest.update(change_manifest)
    members["manifest.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_what_is_wrong_is_named(saved: tuple[VoxelMap, Path]) -> None:
    path = saved[1]
    good = path.read_bytes()
    cases: list[tuple[dict[str, object], str, str]] = [
        ({"version": 99}, "", "format 99"),
        ({"format": "cake"}, "", "cake"),
        ({"label_set": {"name": "x"}}, "", "manifest.json"),
        ({"config": {"voxel_sise_m": 1}}, "", "voxel_size_m"),
        ({"arrays": {}}, "", "'keys'"),
        ({"counters": None}, "", "manifest.json"),
        ({}, "evidence.npy", "'evidence' is missing"),
    ]
    for change, leave_out, message in cases:
        path.write_bytes(good)
        rewrite(path, change, leave_out)
        with pytest.raises(MapError, match=message):
            VoxelMap.load(path)


def test_files_that_are_no_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such map"):
        VoxelMap.load(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(MapError, match="not a map file"):
        VoxelMap.load(tmp_path / "other.npz")
    with pytest.raises(MapError, match=r"damaged or not a map"):
        VoxelMap.load(tmp_path)


def test_failed_save_leaves_the_old_file(saved: tuple[VoxelMap, Path], tmp_path: Path) -> None:
    voxel_map, path = saved
    with pytest.raises(MapError, match="cannot write"):
        voxel_map.save(tmp_path / "no such folder" / "map.npz")
    blocked = tmp_path / "folder.npz"
    blocked.mkdir()
    (blocked / "file").touch()
    with pytest.raises(MapError, match="cannot write"):
        voxel_map.save(blocked)  # a rename onto a folder fails at the very last step
    assert not list(tmp_path.glob(".*tmp"))
    assert same(VoxelMap.load(path).block_state(), voxel_map.block_state())
