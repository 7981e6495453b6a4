"""``finetune --kind panoptic`` on a log, and what ``autolabel`` makes of it."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from semantic_mapper.config import load_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.finetune import finetune_lines
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.boxes import load_boxes
from semantic_mapper.replay.finetune_log import FrameSource, choose_frames, match_boxes, open_pseudo_labels
from semantic_mapper.replay.importers.kitti360 import LABELS
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.jobs import AutolabelRequest, FinetuneRequest, FinetuneResult, autolabel_log, finetune_log
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.training.config import FinetuneConfig
from tests.nodes.cli.test_autolabel import StopsAfter
from tests.nodes.support import error_line, run
from tests.replay.test_boxes import kitti_xml
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
    done = run("finetune", log, *arguments, "--out", out)
    assert done.returncode == 0, done.stderr
    return out, " ".join(done.stdout.split())


def test_boxes_become_labels_and_things_that_never_score(
    log: Path, fitted: tuple[Path, str], config: Path, tmp_path: Path
) -> None:
    (out, said), new = fitted, tmp_path / "labelled.mcap"
    assert "1 of 1 boxes seen" in said and "own label images) of 6 of 6 frames" in said
    assert "1 boxes that move, with grids of their own" in said
    assert "boxes left out: 1 that no frame sees" in said, "of the one that moves later, no frame is of its time"
    checkpoint = load_checkpoint(out)
    assert checkpoint.train_stamps_ns == {f.stamp_ns for f in tiny_frames(6)}  # their labels are true ones
    things = tmp_path / "things"
    done = run("autolabel", log, "--weights", out, "--overwrite-labels", "--instances", things, "--out", new)
    assert done.returncode == 0, done.stderr
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
    done = run("eval", new, "--weights", out)
    assert done.returncode == 1 and "pseudo" in error_line(done.stderr)
    # As if nobody had seen the true labels, its things are scored against themselves.
    unseen, file = tmp_path / "unseen.safetensors", tmp_path / "eval.json"
    save_checkpoint(replace(checkpoint, recipe=checkpoint.recipe | {"train_stamps_ns": []}), unseen)
    few = ("--instances", things, "--max-frames", "1", "--config", config)
    done = run("eval", log, "--weights", unseen, *few, "--out", file)
    assert done.returncode == 0, done.stderr
    methods = json.loads(file.read_text())["logs"][str(log)]["methods"]
    assert methods["panoptic"]["panoptic_frames"] == methods["map seen from frames"]["panoptic_frames"] == 1
    assert methods["panoptic"]["pq_per_class"][listed[0]["class"]]["pq"] > 0.5
    assert "pq" not in methods["panoptic, novel view"]


def test_a_stop_leaves_no_images_of_things(log: Path, fitted: tuple[Path, str], tmp_path: Path) -> None:
    things, new = tmp_path / "things", tmp_path / "new.mcap"
    request = AutolabelRequest((log,), new, fitted[0], overwrite_labels=True, instances=things)
    for before in ([], ["mine"]):
        for name in before:
            (things / name).mkdir(parents=True)
        with pytest.raises(KeyboardInterrupt):
            autolabel_log(request, StopsAfter(2))
        assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == (
            ["things", "things/mine"] * len(before)
        )


def test_ctrl_c_while_geometry_is_fitted_leaves_what_the_boxes_say(
    log: Path, boxes: Path, settings: Path, tmp_path: Path
) -> None:
    out = tmp_path / "w.safetensors"
    config = load_config(settings, FinetuneConfig)
    request = FinetuneRequest(log, out, config=config, kind="panoptic", boxes=boxes)

    def fit_and_press_at(note: str, stop: StopRequest) -> FinetuneResult:
        def set_and_press(done: int, said: str = "") -> None:
            if said.startswith(note):
                os.kill(os.getpid(), signal.SIGINT)

        with frame_progress("fit", None, stop=stop) as bar, patch.object(bar, "set", set_and_press):
            return finetune_log(request, bar)

    with StopRequest() as stop, pytest.raises(KeyboardInterrupt):
        fit_and_press_at("reading", stop)
    assert not out.exists()
    with StopRequest() as stop:
        result = fit_and_press_at("step 3", stop)
    checkpoint = result.checkpoint
    assert (checkpoint.recipe["grid_steps"], checkpoint.recipe["steps"]) == (3, 0)
    assert "those of the boxes alone" in " ".join(finetune_lines(result, request))
    assert load_checkpoint(out).model.config.classes == "fixed"


def test_frames_with_labels_go_before_others() -> None:
    assert choose_frames(10, 4, None) == choose_frames(10, 4, frozenset(range(10))) == [0, 3, 6, 9]
    assert choose_frames(10, 4, frozenset((1, 2, 3))) == [0, 1, 2, 3]
    assert choose_frames(10, 2, frozenset((1, 2, 3, 8))) == [1, 8]
    assert choose_frames(3, 9, frozenset((1,))) == [0, 1, 2]


def test_a_class_that_labels_lack_says_whose_classes_they_are(log: Path, boxes: Path, tmp_path: Path) -> None:
    strange = tmp_path / "strange.json"
    strange.write_text(boxes.read_text().replace('"class": "', '"class": "un'))
    expected = r"own label images: correct the classes of the boxes"
    with open_log(log) as opened, pytest.raises(ConfigError, match=expected):
        match_boxes(load_boxes(strange), strange, open_pseudo_labels(opened, None))


def test_boxes_by_frame_of_a_drive_are_refused_for_another_log(log: Path, boxes: Path, tmp_path: Path) -> None:
    timeless = tmp_path / "timeless.json"
    timeless.write_text(boxes.read_text().replace('"stamps"', '"frames"'))
    done = run("finetune", log, "--kind", "panoptic", "--boxes", timeless, "--out", tmp_path / "w.safetensors")
    assert done.returncode == 1 and "give the log that `import` made of the drive" in error_line(done.stderr)


def write_drive(root: Path, boxes: Path) -> Path:
    """The frames of the log as a drive of KITTI-360 with scans and labels, the boxed thing a truck, all else building;
    and XML: this truck, two that move, one of them at a frame that is not in the drive, and a lamp out of view."""
    drive, camera = "2013_05_28_drive_0000_sync", "image_00"
    still = json.loads(boxes.read_text())["boxes"][0]
    thing = ROOMS.id_of(still["class"])
    files: dict[str, str] = {}
    for number, frame in enumerate(tiny_frames(6)):
        k, name = frame.intrinsics, f"{100 + number:010d}"
        assert frame.label is not None and frame.depth_m is not None
        points = unproject(frame.depth_m, k)[frame.depth_m > 0]
        label = np.where(frame.label == thing, LABELS.id_of("truck"), LABELS.id_of("building")).astype(np.uint8)
        for folder, image in (
            (f"data_2d_raw/{drive}/{camera}/data_rect", frame.rgb[..., ::-1]),
            (f"data_2d_semantics/train/{drive}/{camera}/semantic", label),
        ):
            (root / folder).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / folder / f"{name}.png"), image)
        scans = root / f"data_3d_raw/{drive}/velodyne_points/data"
        scans.mkdir(parents=True, exist_ok=True)
        ahead_left_up = np.stack((points[:, 2], -points[:, 0], -points[:, 1], np.ones(len(points))), axis=1)
        ahead_left_up.astype("<f4").tofile(scans / f"{name}.bin")
        rows = f"P_rect_00: {k.fx} 0 {k.cx} 0 0 {k.fy} {k.cy} 0 0 0 1 0\nS_rect_00: {k.width} {k.height}\n"
        files["calibration/perspective.txt"] = f"{rows}R_rect_00: 1 0 0 0 1 0 0 0 1\n"
        row = " ".join(map(str, (100 + number, *frame.T_world_camera.ravel())))
        files["poses"] = files.get("poses", "") + row + "\n"
    files[f"data_poses/{drive}/cam0_to_world.txt"] = files.pop("poses")
    files["calibration/calib_cam_to_velo.txt"] = "0 0 1 0 -1 0 0 0 0 -1 0 0\n"
    T = np.array(still["T_world_box"])
    T[:3, :3] = np.diag(still["size"])
    far = T + np.array([[0, 0, 0, 5000.0]] + 3 * [[0, 0, 0, 0]])
    objects = ((8, "truck", -1, T), (9, "truck", 100 + WHEN, T), (10, "truck", 4000, T), (11, "lamp", -1, far))
    files["boxes.xml"] = kitti_xml(*objects)
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root / "boxes.xml"


def test_a_drive_of_kitti360_and_its_boxes_are_used_as_they_are(boxes: Path, settings: Path, tmp_path: Path) -> None:
    xml, log, out = write_drive(tmp_path / "drive", boxes), tmp_path / "drive.mcap", tmp_path / "w.safetensors"
    done = run("import", tmp_path / "drive", log)
    assert done.returncode == 0, done.stderr
    arguments = ("--kind", "panoptic", "--boxes", xml, "--steps", "10", "--seconds", "0", "--config", settings)
    done = run("finetune", log, *arguments, "--out", out)
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert "1 of 1 boxes seen" in said and "own label images) of 6 of 6 frames" in said
    assert "1 boxes that move" in said and "left out: 1 that no frame sees; 1 that move, which no frame shows" in said
    field = load_checkpoint(out).model
    assert isinstance(field, Panoptic) and {(b.id, b.class_name) for b in field.shape.boxes} == {
        (9, "truck"),
        (10, "truck"),
    }


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
    request = FinetuneRequest(log, log, config=FinetuneConfig(width=96), unlabelled=0)
    with open_log(log) as opened:
        labels = open_pseudo_labels(opened, str(weights))
        taught = FrameSource(opened, None, request, {}).pseudo_labelled(labels, JobMonitor())
        mapper = Mapper.load(weights)
        own = [mapper.step(replace(frame, label=None)).label for frame in opened]
    nothing, mapped, changed = mapper.label_set.ignore_id, 0, 0
    for frame, label in zip(taught, own, strict=True):
        assert frame.label is not None and frame.label_is_pseudo
        seen = mapper.voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label
        np.testing.assert_array_equal(frame.label, np.where(seen == nothing, label, seen))
        mapped, changed = mapped + int((seen != nothing).sum()), changed + int((frame.label != label).sum())
    assert mapped and changed
