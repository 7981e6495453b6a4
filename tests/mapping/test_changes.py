"""What a map says changed is what its own voxels say, rounded; and asking again and again leads to the present map."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping import changes as changes_module
from semantic_mapper.mapping.blocks import BlockValues, pack_blocks
from semantic_mapper.mapping.changes import BlockChanges, oldest_first
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.grids import decided, random_grid
from tests.mapping.rendered_views import small_map
from tests.mapping.test_paging import MEMORY_MB, walk

FIELDS = ("keys", "tsdf", "label", "confidence", "rgb")


def collect(voxel_map: VoxelMap, limit: int, grow: int) -> dict[tuple[int, ...], tuple[bytes, ...]]:
    """Ask with a limit until nothing is new, while the map takes ``grow`` more frames."""
    blocks: dict[tuple[int, ...], tuple[bytes, ...]] = {}
    version = 0
    while version < voxel_map.frames:
        changes = voxel_map.changes(version, limit)
        assert changes.since == version < changes.version
        version = changes.version
        blocks |= contents(changes)
        if grow:
            walk(voxel_map, 1, first=grow)
            grow -= 1
    return blocks


def contents(changes: BlockChanges) -> dict[tuple[int, ...], tuple[bytes, ...]]:
    rows = zip(changes.tsdf, changes.label, changes.confidence, changes.rgb, strict=True)
    return {tuple(k.tolist()): tuple(a.tobytes() for a in row) for k, row in zip(changes.keys, rows, strict=True)}


@pytest.mark.parametrize("limit", [1, 200, 400, 10**6])
def test_asking_on_leads_to_the_present_map(limit: int) -> None:
    voxel_map = small_map()
    walk(voxel_map, 5)
    assert collect(voxel_map, limit, grow=4) == contents(voxel_map.changes(0))
    assert voxel_map.frames == 9


def test_blocks_that_every_frame_changes_are_not_put_off_for_ever() -> None:
    versions, since = np.zeros(400, np.int64), 0
    for frame in range(1, 20):
        versions[10 * frame : 10 * frame + 90] = frame  # the view moves on by 10 of its 90 blocks
        if frame > 1:  # the first copy comes late
            _, since = oldest_first(versions[versions > since], since, 50, frame)
    assert since == frame


@pytest.mark.slow
@pytest.mark.parametrize("memory_mb", [0, MEMORY_MB])
def test_a_copy_is_made_compact_later_and_is_of_its_moment(memory_mb: int) -> None:
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=memory_mb)
    walk(voxel_map, 6)
    for since, limit in ((0, 0), (2, 0), (0, 700)):
        at_once, copied = voxel_map.changes(since, limit), voxel_map.copy_changes(since, limit)
        walk(voxel_map, 2)
        later = copied.compact()
        assert (
            (later.since, later.version, later.epoch)
            == (since, copied.result.version, 0)
            == (since, at_once.version, 0)
        )
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(later, name), getattr(at_once, name), err_msg=name)
        assert len(later.keys) > 300
    assert (voxel_map.stored_blocks > 0) == (memory_mb > 0)
    with pytest.raises(MapError, match="versions 0 to 12"):
        voxel_map.copy_changes(13)


def test_voxels_are_rounded_as_plain_numpy_rounds_them(rng: np.random.Generator) -> None:
    _, buffers = random_grid(rng)
    values = BlockValues(*(getattr(buffers, name).copy() for name in BlockValues._fields))
    values.weight[0, :8], values.weight[0, 8:16] = 5.0, 0.5  # the latter of no sensor
    values.tsdf[0, :8] = (0.0, 1e-9, -1e-9, 3.0, -3.0, 0.5 / 127, -0.5 / 127, np.nan)
    values.color[0, :4, 0] = (np.nan, -7.0, 300.0, 254.5)
    order, ids = np.array([3, 0, 6], np.int32), np.array([9, 5, 7, 2, 0], np.uint8)
    packed = pack_blocks(values, order)
    rows = np.array([1, 2, 0])
    tsdf, label, confidence = np.empty((3, 512), np.int8), np.empty((3, 512), np.uint8), np.empty((3, 512), np.uint8)
    rgb = np.empty((3, 512, 3), np.uint8)
    computed = np.empty((3, 512), np.uint8)
    decision = changes_module.Decision(0.3, 0.4, 0.25)
    changes_module._compact_blocks(packed, rows, ids, decision, tsdf, label, confidence, rgb, computed)
    for row, block in zip(rows, order, strict=True):
        seen, value = values.weight[block] >= 0.25, values.tsdf[block].astype(float)
        steps = np.nan_to_num(np.rint(np.clip(value, -1, 1) * 127))
        steps = np.where((value > 0) & (steps == 0), 1, steps)
        np.testing.assert_array_equal(tsdf[row], np.where(seen, steps, -128))
        np.testing.assert_array_equal(computed[row], seen & (values.weight[block] < 1))
        color = np.nan_to_num(np.clip(values.color[block] + 0.5, 0, 255))
        np.testing.assert_array_equal(rgb[row], np.where(seen[:, None], color, 0).astype(np.uint8))
        for voxel in range(512):
            best, p = -1, 0.0
            if seen[voxel]:
                best, p = decided(values.evidence[block, voxel], float(values.votes[block, voxel]), 0.3, 0.4)
            assert (label[row, voxel], confidence[row, voxel]) == (ids[best], int(p * 255 + 0.5))
