"""Compile (or load from numba's cache) what the queries need, before anybody waits for an answer."""

from __future__ import annotations

import numpy as np

from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.changes import UNOBSERVED, BlockChanges
from semantic_mapper.queries.boxes import points_in_box
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.lookup import at
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.occupancy import distance_field, occupancy
from semantic_mapper.queries.rays import cast_rays


def warm_up() -> None:
    """Ask a map of one block everything once, but for meshes (which need Open3D)."""
    tsdf = np.full((1, 512), UNOBSERVED, np.int8)
    tsdf[0, :256], tsdf[0, 256:320] = -30, 30  # a level surface between its fourth and fifth layer
    flat = np.ones((1, 512), np.uint8)
    changes = BlockChanges(0, 1, 1, 0, np.zeros((1, 3), np.int32), tsdf, flat, flat, np.zeros((1, 512, 3), np.uint8))
    snapshot = MapMirror(0.1, 4.0, make_label_set("warm-up", ("thing",))).apply(changes)
    points, down = np.array([[0.1, 0.1, 0.3], [0.2, 0.2, 0.6]]), np.array([[0.0, 0.0, -1.0]] * 2)
    at(snapshot, points)
    occupancy(snapshot, points)
    nearest(snapshot, "thing", points[0])
    cast_rays(snapshot, points, down)
    cast_rays(snapshot, points[1], down)  # numba tells origins that stand for several rays from those of their own
    points_in_box(snapshot, (0, 0, 0), (1, 1, 1))
    distance_field(snapshot, (0, 0, 0), (1, 1, 1))
    tracker = InstanceTracker()
    for _ in range(2):  # the second update compares with the first
        tracker.update(snapshot)
