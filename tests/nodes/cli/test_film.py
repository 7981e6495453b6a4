"""Films on the command line: options, what counts as a film, what is reported."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.importing import SourceOptions, film_figures, is_film
from semantic_mapper.replay.sfm.reconstruct import FilmReport, LeftOut
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from tests.nodes.support import run, run_process
from tests.replay import recordings as rec


def test_options_become_one_source_of_scale() -> None:
    assert SourceOptions().film_options().scale.factor is None
    found = SourceOptions(scale=1.5, rotate="90").film_options()
    assert found.scale.factor == 1.5 and found.quarters == 1
    board = SourceOptions(square_mm=39.6).film_options().scale.board
    assert board is not None and board.square_m == pytest.approx(0.0396)
    with pytest.raises(ConfigError, match="one source"):
        SourceOptions(scale=1.5, camera_height=1.2).film_options()


def test_a_folder_of_pictures_is_a_film_unless_it_is_a_recording(tmp_path: Path) -> None:
    (tmp_path / "a.MOV").write_bytes(b"film")
    assert is_film(tmp_path / "a.MOV") and not is_film(tmp_path / "none.mp4")
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    assert not is_film(pictures)
    cv2.imwrite(str(pictures / "1.jpg"), np.zeros((8, 8, 3), np.uint8))
    assert is_film(pictures)
    assert not is_film(rec.make_folder(tmp_path / "kitchen"))


def report(**changes: object) -> FilmReport:
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = (0.0, 1.0, 2.5)
    values = {
        "film": Path("walk.mp4"),
        "looked_at": 10,
        "picked": 4,
        "registered": 3,
        "left_out": (
            LeftOut("blurred", 0.5, 0.7, 3),
            LeftOut("moved too little", 1.0, 2.0, 3),
            LeftOut("blurred", 3, 3, 1),
        ),
        "error_px": 0.61,
        "points": 900,
        "focal_px": 812.5,
        "focal_source": "found",
        "distortion": (0.01, 0.0, 0.0, 0.0),
        "scale": "",
        "height_m": None,
        "T_world_camera": poses,
        "notices": ("the scale is unknown",),
        "info": StreamInfo("film walk.mp4", metadata={SCALE_KEY: SCALE_UNKNOWN}),
        "bytes": 1000,
    }
    return FilmReport(**{**values, **changes})  # type: ignore[arg-type]


def test_figures_say_what_was_left_out_and_that_lengths_are_no_metres() -> None:
    assert report().left_out_counts == {"blurred": 4, "moved too little": 3} and report().path_m == 2.5
    shown = " ".join(film_figures(report()).values())
    for text in ("4 blurred, 3 moved too little", "3 of 4 frames", "2.50 units (scale unknown)", "812.5 px", "0.61 px"):
        assert text in shown
    shown = " ".join(film_figures(report(scale="given", height_m=1.4)).values())
    assert "2.50 m" in shown and "1.40 m" in shown


def test_options_of_films_are_refused_for_recordings(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    done = run("import", folder, tmp_path / "a.mcap", "--camera-height", "1.4")
    assert done.returncode == 2 and "for films" in " ".join(done.stderr.split())


def test_what_is_no_film_is_refused_by_the_verb(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no film")
    done = run_process("replay", tmp_path / "a.mp4", "--out", tmp_path / "out")
    assert done.returncode == 1 and "no film that OpenCV can decode" in done.stderr
    assert done.stderr.startswith("error: ") and len(done.stderr.splitlines()) == 1  # FFmpeg's own lines are not shown
    assert not (tmp_path / "out" / "a.mcap").exists()


def test_weights_that_are_not_there_are_told_before_the_film_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no film")
    done = run("replay", tmp_path / "a.mp4", "--out", tmp_path / "out", "--weights", tmp_path / "nope.safetensors")
    assert done.returncode == 1 and "nope.safetensors" in done.stderr


@pytest.mark.parametrize("depth", [True, False])
def test_a_recording_without_any_depth_is_mapped_with_the_weights_for_computed_depth(
    tmp_path: Path, depth: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    if not depth:
        shutil.rmtree(folder / "depth")
    (folder / "color" / sorted(file.name for file in (folder / "color").iterdir())[1]).write_bytes(b"damaged")
    done = run("replay", folder, "--out", tmp_path / "out")
    said = done.stderr + capfd.readouterr().err
    assert ("rooms-computed-depth.safetensors" in said) != depth and "mapping" in said
    assert "frame left out: frame 1" in done.stdout  # what `import` says is not lost
