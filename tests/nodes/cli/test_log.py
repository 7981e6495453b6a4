"""``info`` of maps."""

import json
from pathlib import Path

import numpy as np

from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import run_ok


def test_info_of_a_map_says_what_it_is(tmp_path: Path) -> None:
    voxel_map, path = small_map(voxel_size_m=0.03), tmp_path / "map.npz"
    fuse_sphere(voxel_map, 3)
    voxel_map.save(path)
    said = run_ok("info", path).stdout
    assert all(text in said for text in ("version 4", "3, the last one at", "3 cm", "72", "three: table, cup, wall"))
    found = json.loads(run_ok("info", path, "--json").stdout)
    assert (found["frames"], found["last_stamp_ns"], found["blocks"]) == (3, 1002, voxel_map.block_count)
    keys = voxel_map.block_state()["keys"]
    np.testing.assert_allclose(found["bounds_m"], [keys.min(axis=0) * 0.24, (keys.max(axis=0) + 1) * 0.24])
    assert found["label_set"] == {"name": "three", "ids": [5, 9, 2], "classes": ["table", "cup", "wall"]}
    assert found["config"]["voxel_size_m"] == 0.03 and found["size_bytes"] == path.stat().st_size
