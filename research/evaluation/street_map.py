"""The arm of STREETS that users have without a field: the map of predicted labels and depth, cast back into frames."""

from __future__ import annotations

import numpy as np

from research.scenes.suite import STREETS_SUITE
from research.suites.scene_runs import ViewScores
from research.suites.streets import Answer, StreetsConfig, drive, score_street
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import PosedFrame

VOXEL_M, DEPTH_MAX_M = 0.2, 60.0
RIGHT = 0.7  # probability that a predicted label is right


def map_arm(config: StreetsConfig, seed: int) -> ViewScores:
    """Fuse all left frames; a frame's answer is the map's where a ray meets it, else its own predicted label."""
    street, label_set = drive(config, seed), STREETS_SUITE.label_set
    settings = VoxelMapConfig(voxel_size_m=VOXEL_M, depth_max_m=DEPTH_MAX_M)
    voxel_map = VoxelMap(settings, label_set)
    rows = np.full((len(label_set), len(label_set)), (1 - RIGHT) / (len(label_set) - 1), np.float32)
    np.fill_diagonal(rows, RIGHT)
    for frame, predicted in zip(street.frames(), street.pseudo, strict=True):
        assert frame.depth_m is not None
        channel = label_set.to_channels(predicted).astype(np.int32)
        voxel_map.integrate(frame, frame.depth_m, rows, rows=channel)

    def answer(frame: PosedFrame) -> Answer:
        seen = voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics)
        label = np.where(seen.label == label_set.ignore_id, street.pseudo[frame.seq], seen.label)
        return Answer(label, None, seen.depth_m)

    return score_street(config, street, answer)
