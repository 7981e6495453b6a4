"""``calibrate``: from folders, videos and logs to files that drivers read."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.calibrating.rig import solve
from semantic_mapper.drivers.calibrating.views import CalibrationConfig
from semantic_mapper.drivers.calibration import load_calibration, load_mount, load_stereo
from semantic_mapper.drivers.stereo.depth import StereoDepth
from semantic_mapper.errors import CameraError, ConfigError
from semantic_mapper.nodes.calibration.report import CalibrationSettings, as_json, tables, write_files
from semantic_mapper.nodes.calibration.sources import Gathering, parse_sources
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame
from tests.contract.golden import form, undocumented
from tests.drivers.calibrating.boards import BOARD, LENS, picture, shown
from tests.drivers.support import write_film
from tests.mapping.test_blocks import files_at_most
from tests.nodes.support import refused, run_ok

SETTINGS = CalibrationSettings(board=BOARD)
BOARD_FILE = '[board]\nkind = "board"\ncolumns = 8\nrows = 6\nsquare_m = 0.04\nmarker_m = 0.03\n'


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrate") / "front"
    folder.mkdir()
    for seq, (_, image) in enumerate(shown()):
        cv2.imwrite(str(folder / f"{seq:02d}.png"), image.rgb)
    return folder


def gather(*sources: str, seconds: float = 60.0, config: CalibrationConfig | None = None) -> Gathering:
    gathering = Gathering(BOARD, config or CalibrationConfig())
    gathering.run(parse_sources(sources, ""), StopRequest(), seconds, rig=len(sources) > 1)
    return gathering


def test_a_folder_becomes_a_file_that_drivers_read_and_a_picture(pictures: Path, tmp_path: Path) -> None:
    config = tmp_path / "board.toml"
    config.write_text(BOARD_FILE)
    out, sheet = tmp_path / "made", tmp_path / "sheet.png"
    done = run_ok("calibrate", pictures, "--config", config, "--out", out, "--board", sheet, "--json")
    told = json.loads(done.stdout)
    assert undocumented("calibrate", form(told)) == []
    read = load_calibration(out / "camera.toml")
    assert abs(read.fx / LENS.fx - 1) < 0.005 and (read.width, read.height) == (640, 480)
    assert told["cameras"]["camera"]["fx"] == read.fx and told["cameras"]["camera"]["k1"] == read.distortion[0]
    assert told["files"] == [str(out / "camera.toml")] and told["rig"] is None
    assert load_mount(out / "camera.toml") is None
    drawn = cv2.imread(str(sheet), cv2.IMREAD_GRAYSCALE)
    assert drawn is not None and drawn.shape[1] > drawn.shape[0] > 2000


def test_a_rig_is_written_into_the_files_of_its_cameras(pictures: Path, tmp_path: Path) -> None:
    gathered = gather(f"left={pictures}", f"right={pictures}")  # one camera twice: they sit at one place
    found = solve(gathered.cameras, (), SETTINGS.calibration, rig=True)
    files = write_files(tmp_path, found, SETTINGS)
    assert [f.name for f in files] == ["left.toml", "right.toml"]
    mount = load_mount(tmp_path / "right.toml")
    assert mount is not None and np.allclose(mount, np.eye(4), atol=1e-6)
    np.testing.assert_array_equal(mount, found.rig["right"].T_rig_camera)
    assert load_calibration(tmp_path / "left.toml") == found.cameras["left"].intrinsics
    told = as_json(found, gathered.cameras, files)
    assert json.loads(json.dumps(told)) == told and told["rig"]["cameras"]["left"]["moments"] > 8
    assert len(list(tables(told))) == 3


def test_a_log_names_its_cameras_itself(tmp_path: Path) -> None:
    path = tmp_path / "board.mcap"
    intrinsics = shown()[0][1].intrinsics
    with LogWriter(path, StreamInfo("test", {"front": intrinsics})) as log:
        for seq in range(6):
            rgb = shown()[seq // 2][1].rgb  # each board is held still for two frames
            log.write_frame(PosedFrame(seq * 50_000_000 + 1, seq, "front", rgb, None, None, intrinsics, np.eye(4)))
    gathered = gather(str(path))
    front = gathered.cameras["front"]
    assert list(gathered.cameras) == ["front"] and (front.images, front.seen, len(front.steady)) == (6, 6, 3)
    assert front.intrinsics == intrinsics and not gathered.known


def test_a_live_camera_is_looked_through_until_nothing_is_lacking(tmp_path: Path) -> None:
    film = write_film(tmp_path / "film.avi", [image.rgb for _, image in shown() for _ in range(2)], 30)
    (source,) = parse_sources([str(film)], "")
    gathering = Gathering(BOARD, CalibrationConfig())
    gathering.run([dataclasses.replace(source, live=True)], StopRequest(), 120.0, rig=False)
    assert gathering.lacks(rig=False) == [] and gathering.cameras["camera"].images <= 40
    assert "several cameras saw the board held still" in gathering.lacks(rig=True)[0]
    assert len(gathering.cameras["camera"].kept) >= SETTINGS.calibration.min_views


def test_poor_coverage_is_refused_in_one_line(pictures: Path, tmp_path: Path) -> None:
    left = tmp_path / "left"
    left.mkdir()
    for number, (T, _) in enumerate(shown()):
        if T[0, 3] < -0.05:  # the board is at the left
            name = f"{number:02d}.png"
            (left / name).write_bytes((pictures / name).read_bytes())
    config = tmp_path / "board.toml"
    config.write_text(BOARD_FILE + "[calibration]\nmin_views = 4\n")
    line = refused("calibrate", left, "--config", config, "--out", tmp_path / "none" / "deep")
    assert "camera 'camera' cannot be calibrated" in line and "right" in line and "hold it there, too" in line
    assert not (tmp_path / "none").exists(), "what was made for the results goes with them"


def test_a_board_that_does_not_fit_on_the_disk_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    with files_at_most(1000):
        said = refused("calibrate", "--board", tmp_path / "board.png")
    assert f"error: {tmp_path / 'board.png'}: cannot be written: File too large" in said
    assert not list(tmp_path.iterdir())
    run_ok("calibrate", "--board", tmp_path / "board.png")
    assert [file.name for file in tmp_path.iterdir()] == ["board.png"]


@pytest.mark.parametrize("swapped", [False, True])
def test_a_pair_that_gives_its_images_side_by_side_becomes_one_folder(tmp_path: Path, swapped: bool) -> None:
    lens = dataclasses.replace(LENS, fx=430.0, fy=428.0, cx=318.0, cy=241.0)
    T_right_left = np.eye(4)
    T_right_left[:3, :3] = cv2.Rodrigues(np.radians((0.5, 1.2, -0.4)))[0]
    T_right_left[:3, 3] = (-0.06, 0.001, 0.002)
    folder = tmp_path / "pair"
    folder.mkdir()
    for seq, (T_left_board, image) in enumerate(shown()):
        both = [image.rgb, picture(T_right_left @ T_left_board, lens)]
        cv2.imwrite(str(folder / f"{seq:02d}.png"), np.hstack(both[::-1] if swapped else both))
    (tmp_path / "board.toml").write_text(BOARD_FILE)
    run_ok("calibrate", "--stereo", folder, "--config", tmp_path / "board.toml", "--out", tmp_path / "made")
    pair = load_stereo(tmp_path / "made" / "stereo")
    assert pair.swapped is swapped
    assert abs(pair.left.fx / LENS.fx - 1) < 0.005 and abs(pair.right.fx / lens.fx - 1) < 0.005
    assert np.abs(pair.T_right_left[:3, 3] - T_right_left[:3, 3]).max() < 0.001
    apart = pair.T_right_left[:3, :3].T @ T_right_left[:3, :3]
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(apart)[0])) < 0.2
    assert StereoDepth(pair, 640, 0.4, 8.0).baseline_m == pytest.approx(0.06, abs=0.001)


def test_what_is_no_source_is_told(pictures: Path, tmp_path: Path) -> None:
    twice = [str(pictures), str(pictures)]
    for texts, size, stereo, says in (
        (["nowhere.mp4"], "", False, "neither a folder"),
        (["v4l3:/dev/video0"], "", False, "v4l2, opencv, oak, realsense"),
        (["a b=x"], "", False, "cannot be the name"),
        (["v4l2:/dev/video0"], "large", False, "WIDTHxHEIGHT"),
        (twice, "", True, "--stereo calibrates one device"),
        (twice, "", False, "two cameras have one name in front, front"),
    ):
        with pytest.raises(ConfigError, match=says):
            parse_sources(texts, size, stereo=stereo)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CameraError, match="no pictures in it"):
        gather(str(tmp_path / "empty"))
    (tmp_path / "empty" / "a.png").write_bytes(b"x")
    with pytest.raises(CameraError, match=r"a\.png: is no picture"):
        gather(str(tmp_path / "empty"))
