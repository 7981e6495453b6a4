from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from research.evaluation.room_map import in_rooms, map_room, true_surface
from research.scenes import make_room
from research.suites.figures import map_figures
from research.suites.scoring import from_rows
from research.tests.suites.tiny import ROOM, tiny_room, tiny_suite
from semantic_mapper.labels import ROOMS, make_label_set
from tests.nodes.support import write_weights

MAPPER = {"render": {"encode_width": 48, "scale": 0.125}, "voxel_map": {"voxel_size_m": 0.05, "unknown_below": 0.0}}


def test_true_surface_lies_on_the_floor_where_it_says_floor() -> None:
    poses = [frame.T_world_camera for frame in tiny_room().frames[::7]]
    surface = true_surface(make_room(ROOM), poses)
    floor = ROOMS.ids[ROOMS.names.index("floor")]
    assert len(surface.xyz) == len(surface.label) > 1000
    assert np.abs(surface.xyz[surface.label == floor][:, 2]).max() < 0.05
    cells = np.floor(surface.xyz / 0.01).astype(np.int64)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_ids_of_another_label_set_are_translated_by_name() -> None:
    two = make_label_set("two", ["curb", "wall"], ids=[7, 9], ignore_id=255)
    wall = ROOMS.ids[ROOMS.names.index("wall")]
    np.testing.assert_array_equal(
        in_rooms(np.array([7, 9, 255], np.uint8), two), [ROOMS.ignore_id, wall, ROOMS.ignore_id]
    )


@pytest.mark.timeout(120)
def test_a_mapped_room_is_scored_at_its_own_points_and_at_the_true_surface(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    record = map_room(ROOM, weights, "digest", tiny_suite(mapper=MAPPER))
    assert record.points > 500 and record.on_surface > 0.9
    at_points, at_surface = from_rows(record.confusion), from_rows(record.surface_confusion)
    assert at_points.counts.sum() == round(record.on_surface * record.points)
    assert at_surface.counts.sum() > at_points.counts.sum()
    frames = from_rows(record.view_confusion).counts.sum()
    assert 0 < frames <= 3 * 320 * 240
    cast, there = from_rows(record.cast_confusion), from_rows(record.cast_view_confusion)
    assert 0.5 * frames < cast.counts.sum() == there.counts.sum() <= frames
    np.testing.assert_array_equal(cast.counts.sum(1), there.counts.sum(1))
    assert cast.counts[:, -1].sum() == 0, "only pixels where the map has a label are counted"
    fused, single = from_rows(record.seen_confusion), from_rows(record.one_frame_confusion)
    np.testing.assert_array_equal(fused.counts.sum(1), single.counts.sum(1))
    assert 0.9 * at_points.counts.sum() < fused.counts.sum() <= at_points.counts.sum()
    assert not np.array_equal(fused.counts, single.counts)
    figures = map_figures([record])
    assert figures["cast_miou"] == cast.metrics().miou
    assert figures["map_miou"] == figures["map_miou_mean_of_rooms"] == at_points.metrics().miou
    assert figures["view_miou_mean_of_rooms"] == record.view_miou
    assert record.panoptic is not None
    _, right, wrong, missed, _ = np.array(record.panoptic.sums)
    assert right.sum() + missed.sum() > 10 and (wrong >= 0).all()
    assert 0 <= figures["pq"] <= figures["pq_plus"] <= 1 and set(figures["pq_by_class"]) >= {"wall", "floor"}
    assert map_figures([msgspec.structs.replace(record, panoptic=None)])["pq"] is None, "an older record"
