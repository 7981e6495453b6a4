"""The generated street: what its camera and scanner see agrees, and follows from the seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from research.experiments.street import T_CAMERA_SCANNER, camera_of_width, write_drive
from research.scenes import Scene
from research.scenes.config import NoiseConfig
from research.scenes.shots import single_shot
from research.scenes.streets.drive import CLASSES, MAX_RANGE_M, drive, make_street, render_street, scan_street
from semantic_mapper.replay.importers import import_recording
from semantic_mapper.replay.importers.kitti360 import LABELS, depth_of_scan
from semantic_mapper.replay.log.format import LogReader

ID = dict(zip(LABELS.names, LABELS.ids, strict=True))
CAMERA = camera_of_width(352)


@pytest.fixture(scope="module")
def street() -> Scene:
    return make_street(3, 20.0, LABELS)


def test_it_has_the_classes_of_a_street_and_a_sky_without_depth(street: Scene):
    seen: set[int] = set()
    for pose in drive(street, 30)[::6]:
        view = render_street(street, CAMERA, pose, single_shot(0, NoiseConfig()), NoiseConfig(), 0)
        assert view.rgb.shape == (94, 352, 3) and view.label.shape == (94, 352)
        assert np.array_equal(view.label == ID["sky"], view.exact_depth_m == 0)
        seen |= set(np.unique(view.label).tolist())
    assert {"road", "sidewalk", "parking", "terrain", "building", "vegetation", "car", "sky", "pole"} <= {
        name for name in CLASSES if ID[name] in seen
    }


def test_it_follows_from_the_seed(street: Scene):
    pose = drive(street, 2)[1]
    shot = single_shot(0, NoiseConfig())
    again = make_street(3, 20.0, LABELS)
    other = make_street(4, 20.0, LABELS)
    views = [render_street(s, CAMERA, pose, shot, NoiseConfig(), 1) for s in (street, again, other)]
    assert np.array_equal(views[0].rgb, views[1].rgb) and np.array_equal(views[0].label, views[1].label)
    assert (views[0].label != views[2].label).mean() > 0.05


def test_things_cast_shadows_onto_some_of_the_road(street: Scene):
    """Against the same street with a sun that shines through everything, and with one that is covered."""
    pose, steady = drive(street, 2)[1], NoiseConfig(auto_exposure=0.0, read_noise=0.0, shot_noise=0.0)
    day = street.daylight
    assert day is not None
    shadows = (day.shadow, np.full_like(day.shadow, np.inf), np.zeros_like(day.shadow))
    cast, lit, covered = (
        render_street(
            replace(street, daylight=replace(day, shadow=s)), CAMERA, pose, single_shot(0, steady), steady, 0
        ).rgb.astype(int)
        for s in shadows
    )
    assert (covered <= cast).all() and (cast <= lit).all()
    assert 0.02 < ((lit - cast).max(axis=-1) > 20).mean() < 0.7 and ((cast - covered).max(axis=-1) > 20).mean() > 0.02


def test_the_scanner_measures_what_the_camera_sees(street: Scene):
    pose = drive(street, 2)[1]
    exact = render_street(street, CAMERA, pose, single_shot(0, NoiseConfig()), NoiseConfig(), 0).exact_depth_m
    points = scan_street(street, pose @ T_CAMERA_SCANNER, 0)
    assert np.linalg.norm(points[:, :3], axis=1).max() < MAX_RANGE_M + 0.2
    depth = depth_of_scan(points[:, :3].astype(np.float64), T_CAMERA_SCANNER, CAMERA)
    both = (depth > 0) & (exact > 0)
    assert 0.2 < both.mean() < 0.6 and ((depth > 0) & (exact == 0)).mean() < 0.01
    error = np.abs(depth - exact)[both] / exact[both]
    assert np.median(error) < 0.01 and (error < 0.05).mean() > 0.8  # the rest: edges, which both sample


def test_a_written_drive_is_imported_with_labels_and_depth(tmp_path: Path):
    write_drive(tmp_path / "street", frames=2, width=176, seed=3)
    report = import_recording(tmp_path / "street", tmp_path / "street.mcap")
    assert (report.frames, report.labelled, report.with_depth, report.skipped) == (2, 2, 2, ())
    with LogReader(tmp_path / "street.mcap") as log:
        frames = list(log)
        assert log.info.label_set == LABELS
    way = np.linalg.norm(frames[1].T_world_camera[:3, 3] - frames[0].T_world_camera[:3, 3])
    assert 0.7 < way < 0.9
