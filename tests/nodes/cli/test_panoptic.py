"""``finetune --kind panoptic`` on a log, and what ``autolabel`` makes of it."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.config import MapperConfig, VoxelMapConfig
from semantic_mapper.errors import LogError
from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.autolabel import AutolabelRequest, autolabel_log
from semantic_mapper.replay.finetune_log import FinetuneRequest, FrameSource, open_pseudo_labels
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.training.config import FinetuneConfig
from tests.nodes.cli.test_autolabel import StopsAfter
from tests.nodes.support import refused, run_ok
from tests.small import tiny_frames

BOXED, MOVING = 9, 10  # ids of boxes
WHEN = 2  # the frame in which the second box is there


@pytest.fixture(scope="module")
def boxes(folder: Path) -> Path:
    """A box round what the frames show of their most frequent thing, one that is there in one frame alone, and one that
    is never there."""
    frames = tiny_frames(6)
    labels = np.stack([f.label for f in frames if f.label is not None])
    thing = max(ROOMS.thing_ids(STUFF_NAMES), key=lambda i: int((labels == i).sum()))
    points = [
        transform(f.T_world_camera, unproject(f.depth_m, f.intrinsics)[(f.label == thing) & (f.depth_m > 0)])
        for f in frames
        if f.depth_m is not None
    ]
    low, high = np.percentile(np.concatenate(points), (2, 98), axis=0)
    T = np.eye(4)
    T[:3, 3] = (low + high) / 2
    name = ROOMS.names[ROOMS.ids.index(thing)]
    still = {"id": BOXED, "class": name, "T_world_box": T.tolist(), "size": (high - low + 0.1).tolist()}
    moving = still | {"id": MOVING, "stamps": [[frames[WHEN].stamp_ns, T.tolist()]]}
    away = still | {"id": 11, "stamps": [[10**18, T.tolist()]]}
    path = folder / "boxes.json"
    path.write_text(json.dumps({"boxes": [still, moving, away]}))
    return path


@pytest.fixture(scope="module")
def settings(folder: Path) -> Path:
    path = folder / "small.toml"
    path.write_text("width = 96\n[grid]\nlong_side = 32\nrays = 256\nheld_out = 0\n[step]\nrays = 128\n")
    return path


@pytest.fixture(scope="module")
def fitted(log: Path, boxes: Path, settings: Path, folder: Path) -> tuple[Path, str]:
    """Weights with boxes, and what was said of them."""
    out = folder / "boxed.safetensors"
    arguments = ("--kind", "panoptic", "--boxes", boxes, "--steps", "30", "--seconds", "0", "--config", settings)
    done = run_ok("finetune", log, *arguments, "--out", out)
    return out, " ".join(done.stdout.split())


def test_boxes_become_labels_that_never_score(
    log: Path, fitted: tuple[Path, str], config: Path, tmp_path: Path
) -> None:
    (out, said), new = fitted, tmp_path / "labelled.mcap"
    assert "1 of 1 boxes seen" in said and "own label images) of 6 of 6 frames" in said
    assert "boxes left out: 1 that no frame sees" in said, "of the one that moves later, no frame is of its time"
    checkpoint = load_checkpoint(out)
    assert checkpoint.train_stamps_ns == {f.stamp_ns for f in tiny_frames(6)}  # their labels are true ones
    things = tmp_path / "things"
    run_ok("autolabel", log, "--weights", out, "--overwrite-labels", "--instances", things, "--out", new)
    listed = json.loads((things / "instances.json").read_text())["instances"]
    assert [thing["id"] for thing in listed] == [BOXED, MOVING]
    assert sorted(path.name for path in things.iterdir()) == ["instances.json", "rooms"]
    with open_log(new) as labelled:
        for number, frame in enumerate(labelled):
            assert frame.label is not None and frame.label_is_pseudo
            ids = cv2.imread(str(things / "rooms" / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert ids is not None and ids.dtype == np.uint16 and ids.shape == frame.label.shape
            assert set(np.unique(ids).tolist()) <= ({0, BOXED, MOVING} if number == WHEN else {0, BOXED})
            for thing in listed:
                assert int((ids == thing["id"]).sum()) == thing["pixels"].get(f"rooms/{number:06d}", 0)
            assert (frame.label[ids > 0] == ROOMS.id_of(listed[0]["class"])).all()
    assert listed[0]["pixels"] and list(listed[1]["pixels"]) == [f"rooms/{WHEN:06d}"]
    assert "pseudo" in refused("eval", new, "--weights", out)
    # As if nobody had seen the true labels, its things are scored against themselves.
    unseen, file = tmp_path / "unseen.safetensors", tmp_path / "eval.json"
    save_checkpoint(replace(checkpoint, recipe=checkpoint.recipe | {"train_stamps_ns": []}), unseen)
    few = ("--instances", things, "--max-frames", "1", "--config", config)
    run_ok("eval", log, "--weights", unseen, *few, "--out", file)
    methods = json.loads(file.read_text())["logs"][str(log)]["methods"]
    assert methods["panoptic"]["panoptic_frames"] == methods["map seen from frames"]["panoptic_frames"] == 1
    assert methods["panoptic"]["pq_per_class"][listed[0]["class"]]["pq"] > 0.5
    assert "pq" not in methods["panoptic, novel view"]


def test_a_stop_leaves_no_images_of_things(log: Path, fitted: tuple[Path, str], tmp_path: Path) -> None:
    things, new = tmp_path / "things", tmp_path / "new.mcap"
    request = AutolabelRequest((log,), new, fitted[0], overwrite_labels=True, instances=things)
    with pytest.raises(KeyboardInterrupt):
        autolabel_log(request, StopsAfter(2))
    assert not list(tmp_path.iterdir())
    things.mkdir()
    with pytest.raises(LogError, match="things: exists already"):
        autolabel_log(request)


def test_boxes_that_do_not_fit_are_refused(log: Path, boxes: Path, weights: Path, tmp_path: Path) -> None:
    wrong, text = tmp_path / "wrong.json", boxes.read_text()
    command = ("finetune", log, "--kind", "panoptic", "--boxes", wrong, "--out", tmp_path / "w.safetensors")
    wrong.write_text(text.replace('"class": "', '"class": "x', 1))
    assert "box with id 9: label set 'rooms' has no class" in refused(*command)
    options = ("--weights", weights, "--instances", tmp_path / "i", "--out", tmp_path / "n.mcap")
    assert "has no boxes" in refused("autolabel", log, *options) and not (tmp_path / "i").exists()


def test_weights_teach_with_the_map_that_they_make_of_the_frames(log: Path, weights: Path) -> None:
    request = FinetuneRequest(log, log, config=FinetuneConfig(width=96))
    with open_log(log) as opened:
        labels = open_pseudo_labels(opened, str(weights))
        taught = FrameSource(opened, None, request, JobMonitor(), {}).pseudo_labelled(labels)
        mapper = Mapper.load(weights, MapperConfig(voxel_map=VoxelMapConfig(unknown_below=0.0)))
        own = [mapper.step(replace(frame, label=None)).label for frame in opened]
    nothing, mapped, changed = mapper.label_set.ignore_id, 0, 0
    for frame, label in zip(taught, own, strict=True):
        assert frame.label is not None and frame.label_is_pseudo
        seen = mapper.voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label
        np.testing.assert_array_equal(frame.label, np.where(seen == nothing, label, seen))
        mapped, changed = mapped + int((seen != nothing).sum()), changed + int((frame.label != label).sum())
    assert mapped and changed
