"""``finetune --kind panoptic`` on a log, and what ``autolabel`` makes of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.console import frame_progress
from semantic_mapper.nodes.cli.pseudo_labels import open_pseudo_labels, read_pseudo_labelled
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log.sequence import open_log
from tests.nodes.support import error_line, run
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


def test_boxes_become_labels_and_things_that_never_score(log: Path, boxes: Path, tmp_path: Path) -> None:
    out, settings, new = tmp_path / "w.safetensors", tmp_path / "small.toml", tmp_path / "labelled.mcap"
    settings.write_text("width = 96\n[grid]\nlong_side = 32\nrays = 256\nheld_out = 0\n[panoptic]\nrays = 128\n")
    arguments = ("--kind", "panoptic", "--boxes", boxes, "--steps", "30", "--seconds", "0", "--config", settings)
    done = run("finetune", log, *arguments, "--out", out)
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert "1 of 1 boxes seen" in said and "own label images) of 6 of 6 frames" in said
    assert "1 boxes that move, with grids of their own" in said and "left out: 1 boxes that move" in said
    checkpoint = load_checkpoint(out)
    assert checkpoint.train_stamps_ns == {f.stamp_ns for f in tiny_frames(6)}  # their labels are true ones
    things = tmp_path / "things"
    done = run("autolabel", log, "--weights", out, "--overwrite-labels", "--instances", things, "--out", new)
    assert done.returncode == 0, done.stderr
    listed = json.loads((things / "instances.json").read_text())["instances"]
    assert [thing["id"] for thing in listed] == [BOXED, MOVING]
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
    done = run("eval", new, "--weights", out)
    assert done.returncode == 1 and "pseudo" in error_line(done.stderr)


def test_what_does_not_go_with_boxes_is_refused(log: Path, boxes: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "w.safetensors"
    for arguments, said in (
        (("--kind", "panoptic"), "--kind panoptic and --boxes FILE go together"),
        (("--boxes", boxes, "--keyframes", "2"), "--kind panoptic and --boxes FILE go together"),
        (("--kind", "panoptic", "--boxes", boxes, "--keyframes", "2"), "give them with --pseudo"),
        (("--keyframes", "2", "--uncovered", "empty"), "goes with --kind panoptic only"),
    ):
        done = run("finetune", log, *arguments, "--out", out)
        assert done.returncode == 2 and said in " ".join(done.stderr.split())
    broken = tmp_path / "broken.json"
    broken.write_text(boxes.read_text().replace('"class": "', '"class": "x', 1))
    done = run("finetune", log, "--kind", "panoptic", "--boxes", broken, "--out", out)
    assert done.returncode == 1 and "box with id 9: label set 'rooms' has no class" in error_line(done.stderr)
    done = run("autolabel", log, "--weights", weights, "--instances", tmp_path / "i", "--out", tmp_path / "n.mcap")
    assert done.returncode == 1 and "has no boxes" in error_line(done.stderr)
    assert not (tmp_path / "i").exists()


def test_weights_teach_with_the_map_that_they_make_of_the_frames(log: Path, weights: Path) -> None:
    with open_log(log) as opened, frame_progress("read", len(opened)) as bar:
        labels = open_pseudo_labels(opened, weights)
        taught = read_pseudo_labelled(opened, labels, lambda frame: frame, 0, 96, StopRequest(), bar)
        mapper = Mapper.load(weights)
        own = [mapper.step(replace(frame, label=None)).label for frame in opened]
    nothing, mapped, changed = mapper.label_set.ignore_id, 0, 0
    for frame, label in zip(taught, own, strict=True):
        assert frame.label is not None and frame.label_is_pseudo
        seen = mapper.voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label
        np.testing.assert_array_equal(frame.label, np.where(seen == nothing, label, seen))
        mapped, changed = mapped + int((seen != nothing).sum()), changed + int((frame.label != label).sum())
    assert mapped and changed
