"""A map without metres gets them by a length that is known, whole or not at all."""

import dataclasses
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.map_log import replay_log
from semantic_mapper.replay.rescale import rescale_run
from semantic_mapper.replay.sfm.scale import FLOOR_KEY
from semantic_mapper.replay.summary import read_summary
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, SCENE_DEPTH_KEY, StreamInfo
from semantic_mapper.types import CameraIntrinsics
from tests.contract.golden import form, undocumented
from tests.drawn_room import truth_of, walk_frames
from tests.nodes.support import refused, run_ok

UNIT = 0.8  # of the log in a metre
CAMERA = CameraIntrinsics(136.0, 136.0, 79.5, 59.5, 160, 120)
WALK = walk_frames(3, 12, CAMERA, step_m=0.06)
SETTINGS = {"voxel_map.voxel_size_m": 0.04, "render.encode_width": 96, "render.scale": 0.25}


def write_log(
    folder: Path, name: str = "room.mcap", source: str = "film", *, depth: bool = False, floor: str = ""
) -> None:
    """A walk as a film gives it: z = 0 on the floor."""
    metadata = {SCALE_KEY: SCALE_UNKNOWN, SCENE_DEPTH_KEY: "1.5", FLOOR_KEY: floor}
    info = StreamInfo(source, {"cam": CAMERA}, metadata=metadata)
    with LogWriter(folder / name, info, overwrite=True) as writer:
        for frame in WALK:
            pose = frame.T_world_camera.copy()
            pose[:3, 3] *= UNIT
            depth_m = frame.depth_m if depth else None
            writer.write_frame(dataclasses.replace(frame, T_world_camera=pose, depth_m=depth_m))


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mapped")
    write_log(folder)
    replay_log(folder / "room.mcap", folder, config=load_mapper_config(None, SETTINGS))
    return folder


@pytest.fixture
def run(mapped: Path, tmp_path: Path) -> Path:
    return shutil.copytree(mapped, tmp_path / "run")


def points(run: Path) -> np.ndarray:
    return VoxelMap.load(run / "map.npz").points().xyz


def test_the_height_of_the_camera_scales_log_and_map(run: Path) -> None:
    before, height_m = points(run), float(np.median(truth_of(WALK)[:, 2, 3]))
    report = rescale_run(run, height_m)
    assert report.factor == pytest.approx(1 / UNIT, rel=0.03)
    assert undocumented("scale", form(dataclasses.asdict(report))) == []
    with LogReader(run / "room.mcap") as log:
        assert log.info.scale_known and float(log.info.metadata[SCENE_DEPTH_KEY]) == pytest.approx(1.875, rel=0.03)
        for frame, old in zip(log, WALK, strict=True):
            expected = UNIT * report.factor * old.T_world_camera[:3, 3]
            np.testing.assert_allclose(frame.T_world_camera[:3, 3], expected, atol=1e-9)
            assert (frame.rgb == old.rgb).all()
    summary, after = read_summary(run), points(run)
    assert summary["scale"] == "metres" and summary["config"]["render"]["scale"] == 0.25
    np.testing.assert_allclose(np.median(after, axis=0), report.factor * np.median(before, axis=0), atol=0.15)
    assert not list(run.glob(".scale*")) and (run / "report.html").is_file()


def test_two_points_scale_and_the_command_says_what_has_changed(run: Path) -> None:
    xyz = points(run)
    ends = xyz[np.argmin(xyz[:, 1])], xyz[np.argmax(xyz[:, 1])]
    a, b = (",".join(f"{value:.4f}" for value in end) for end in ends)
    assert "units (scale unknown)" in run_ok("info", run).stdout
    said = run_ok("scale", run, "--known", a, b, "3").stdout
    assert "in metres; scale: two points of the map, 3 m apart" in said and "in voxels of 4 cm" in said
    assert "is no point" in refused("scale", run, "--known", "1,2", b, "3")
    assert np.ptp(points(run), axis=0)[1] == pytest.approx(3 * np.ptp(xyz, axis=0)[1] / math.dist(*ends), rel=0.1)


def test_what_cannot_be_scaled_is_refused_and_stays(run: Path, tmp_path: Path) -> None:
    near, far = points(run)[0].astype(np.float64), np.full(3, 9.0)
    files = {file: file.read_bytes() for file in run.iterdir()}

    class Stopped(JobMonitor):
        stopped_by = ""

        def set(self, done: int, note: str = "") -> None:
            self.stopped_by = "SIGINT" if done > 10 else ""

    for says, pair in (("9,9,9: is .* units from what is mapped", (near, far)), ("points are one", (near, near))):
        with pytest.raises(MapError, match=says):
            rescale_run(run, 1.0, pair)
    rescale_run(run, 1.0, monitor=Stopped())
    assert {file: file.read_bytes() for file in run.iterdir()} == files
    write_log(run, floor="a floor of 60 points, unsure")  # that of the import is the one that counts
    report = rescale_run(run, 1.0, monitor=Stopped())
    assert report.factor == pytest.approx(1 / np.median(UNIT * truth_of(WALK)[:, 2, 3]))
    assert report.scale == "the stated camera height of 1 m over a floor of 60 points, unsure"
    (run / "summary.json").write_text((run / "summary.json").read_text().replace("rooms.safe", "mine.safe"))
    with pytest.raises(ConfigError, match=r"mapped with mine\.safetensors; name the file with --weights"):
        rescale_run(run, 1.0)
    for says, log in (
        ("not the log that the map was made of: film", {"source": "other"}),
        ("12 frames have depth images", {"depth": True}),
        (r"holds 2 logs .*put the one that it was made of there", {"name": "b.mcap"}),
    ):
        write_log(run, **log)
        with pytest.raises(ConfigError, match=says):
            rescale_run(run, 1.0)
