"""The finished map with its things against true classes and objects of its frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from research.scenes import TRAIN_SEEDS
from research.scenes.sequence import room_views
from semantic_mapper.errors import LabelError, LogError
from semantic_mapper.labels import ROOMS, LabelSet, make_label_set
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.things import PanopticTruth
from semantic_mapper.replay.log.sequence import open_log
from tests.nodes.support import write_log
from tests.small import INTRINSICS, tiny_config

VIEWS = list(room_views(TRAIN_SEEDS[7], 4, INTRINSICS))


@pytest.fixture(scope="module")
def log_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("panoptic") / "room.mcap", [view.frame for view in VIEWS])


@pytest.fixture(scope="module")
def voxel_map() -> VoxelMap:
    """Of true classes: what it lacks is due to voxels and to how things are separated."""
    made = VoxelMap(tiny_config().voxel_map, ROOMS)
    for view in VIEWS:
        channel = ROOMS.to_channels(view.rendered.label)
        probabilities = np.full((*channel.shape, len(ROOMS)), 0.001, np.float32)
        np.put_along_axis(probabilities, channel[..., None], 0.95, axis=-1)
        made.integrate(view.frame, view.rendered.depth_m, probabilities / probabilities.sum(-1, keepdims=True))
    return made


def score(log_path: Path, folder: Path, voxel_map: VoxelMap, stream: LabelSet = ROOMS):
    with open_log(log_path) as log:
        truth = PanopticTruth(folder, log, stream, ROOMS)
        for frame in log:
            assert frame.label is not None
            known = [ROOMS.id_of(name) for name in stream.names]
            truth.add(frame, np.where(np.isin(frame.label, known), frame.label, known[0]))
    return truth.score(voxel_map)


def write(folder: Path, number: int, instance: np.ndarray) -> None:
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / f"{number:06d}.png"), instance.astype(np.uint16))


def test_a_map_of_true_classes_is_nearly_right_and_objects_taken_for_one_cost(
    log_path: Path, voxel_map: VoxelMap, tmp_path: Path
) -> None:
    for number, view in enumerate(VIEWS):
        write(tmp_path / "rooms", number, view.rendered.instance)  # in a folder named as the camera
    right = score(log_path, tmp_path, voxel_map)
    assert right["panoptic_frames"] == 4 and right["miou"] > 0.7
    assert right["pq_stuff"] > 0.8 and right["pq_things"] > 0.5
    assert set(right["pq_per_class"]) >= {"wall", "floor"}
    for number in range(4):
        write(tmp_path / "one", number, np.ones_like(VIEWS[0].rendered.instance))
    merged = score(log_path, tmp_path / "one", voxel_map)
    assert merged["pq_things"] < right["pq_things"] and merged["pq_stuff"] == right["pq_stuff"]


def test_frames_without_an_image_do_not_count_and_none_at_all_is_an_error(
    log_path: Path, voxel_map: VoxelMap, tmp_path: Path
) -> None:
    with pytest.raises(LabelError, match="has no images of objects"):
        score(log_path, tmp_path, voxel_map)
    write(tmp_path, 9, VIEWS[0].rendered.instance)
    with pytest.raises(LabelError, match="no image of any frame"):
        score(log_path, tmp_path, voxel_map)
    write(tmp_path, 2, VIEWS[2].rendered.instance)
    few = make_label_set("few", ["wall", "floor"])  # what is found of other classes is as if nothing had been found
    found = score(log_path, tmp_path, voxel_map, few)
    assert found["panoptic_frames"] == 1 and set(found["pq_per_class"]) == {"wall", "floor"}
    write(tmp_path, 1, np.ones((10, 10)))
    with pytest.raises(LogError, match=r"000001\.png.*10x10"):
        score(log_path, tmp_path, voxel_map)
