"""Films on the command line: options, and what counts as a film."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, ImportSourceError
from semantic_mapper.nodes.cli.importing import SourceOptions, is_film
from tests.nodes.support import refused, run, run_process
from tests.replay import bags
from tests.replay import recordings as rec
from tests.small import tiny_frames


def test_options_become_one_source_of_scale_and_are_refused_for_recordings(tmp_path: Path) -> None:
    found = SourceOptions(scale=1.5, rotate="90").film_options()
    assert found.scale.factor == 1.5 and found.quarters == 1
    board = SourceOptions(square_mm=39.6).film_options().scale.board
    assert board is not None and board.square_m == pytest.approx(0.0396)
    with pytest.raises(ConfigError, match="one source"):
        SourceOptions(scale=1.5, camera_height=1.2).film_options()
    folder = rec.make_folder(tmp_path / "kitchen")
    assert "for films" in refused("import", folder, tmp_path / "a.mcap", "--camera-height", "1.4", code=2)


def test_a_folder_of_pictures_is_a_film_unless_it_is_a_recording(tmp_path: Path) -> None:
    (tmp_path / "a.MOV").write_bytes(b"film")
    assert is_film(tmp_path / "a.MOV") and not is_film(tmp_path / "none.mp4")
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    assert not is_film(pictures)
    cv2.imwrite(str(pictures / "1.jpg"), np.zeros((8, 8, 3), np.uint8))
    assert is_film(pictures)
    assert not is_film(rec.make_folder(tmp_path / "kitchen"))
    above = tmp_path / "above"
    shutil.copytree(pictures, above / "images")
    assert is_film(above)
    (above / "traj.txt").touch()
    assert not is_film(above), "as NICE-SLAM renders rooms, which gets advice"
    (above / "traj.txt").unlink()
    shutil.copytree(pictures, above / "more")
    assert not is_film(above)
    shutil.copy(pictures / "1.jpg", pictures / "1.depth.jpg")
    with pytest.raises(ImportSourceError, match=r"two pictures of each number .*N\.depth\.jpg, N\.jpg"):
        is_film(pictures)


def test_what_is_no_film_is_refused_but_not_before_missing_weights_are(tmp_path: Path) -> None:
    film, out = tmp_path / "a.mp4", tmp_path / "out"
    film.write_bytes(b"no film")
    done = run_process("map", film, "--out", out)
    assert done.returncode == 1 and "no film that OpenCV can decode" in done.stderr
    assert done.stderr.startswith("error: ") and len(done.stderr.splitlines()) == 1  # FFmpeg's own lines are not shown
    assert not (out / "a.mcap").exists()
    assert "no topics" in refused("map", film, "--out", out, "--topic", "image=/camera")
    assert "nope.safetensors" in refused("map", film, "--out", out, "--weights", tmp_path / "nope.safetensors")


def test_a_bag_is_not_replaced_by_the_log_of_its_map(tmp_path: Path) -> None:
    bag = bags.write_bag(tmp_path / "bag", "mcap", bags.room_events(bags.Messages("mcap"), tiny_frames(1)))
    (file,) = bag.glob("*.mcap")
    assert "choose another folder" in refused("map", file, "--out", bag) and (bag / "metadata.yaml").exists()


@pytest.mark.parametrize("depth", [True, False])
def test_a_folder_is_imported_and_mapped(tmp_path: Path, depth: bool, capfd: pytest.CaptureFixture[str]) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    if not depth:
        shutil.rmtree(folder / "depth")
    (folder / "color" / sorted(file.name for file in (folder / "color").iterdir())[1]).write_bytes(b"damaged")
    done = run("map", folder, "--out", tmp_path / "out", "--max-frames", "3")
    said = done.stderr + capfd.readouterr().err
    assert "rooms.safetensors" in said and "mapping" in said
    assert "2 frames" in done.stdout and "frame left out: frame 1" in done.stdout  # what `import` says is not lost
