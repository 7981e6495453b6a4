from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from semantic_mapper.replay.sfm.film import Film, FilmLook, look_through, pick_frames
from semantic_mapper.types import UInt8

from . import films


def card(shift: int = 0, size: tuple[int, int] = (96, 128)) -> UInt8:
    """A picture with texture, whose upper left quarter is white."""
    rng = np.random.default_rng(0)
    noise = cv2.resize(rng.integers(0, 200, (size[0] // 4, size[1] // 4 + 64), np.uint8), None, fx=4, fy=4)
    gray = noise[:, shift : shift + size[1]].copy()
    gray[: size[0] // 2, : size[1] // 2] = 255
    return np.ascontiguousarray(np.repeat(gray[:, :, None], 3, axis=2))


def test_a_folder_of_pictures_is_a_film_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    for number in (10, 9, 11):
        cv2.imwrite(str(tmp_path / f"IMG_{number}.jpg"), np.full((30, 40, 3), number, np.uint8))
    cv2.imwrite(str(tmp_path / "IMG_12.png"), np.zeros((20, 40, 3), np.uint8))
    (tmp_path / "IMG_13.jpg").write_bytes(b"no picture")
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    with Image.open(tmp_path / "IMG_9.jpg") as picture:
        picture.save(tmp_path / "IMG_9.jpg", exif=exif, quality=95)
    film = Film(tmp_path)
    frames = list(film)
    assert [round(float(frame.bgr.mean())) for frame in frames] == [9, 10, 11]
    assert [frame.stamp_ns for frame in frames] == [0, 500_000_000, 1_000_000_000]
    assert sorted(file.name for file in film.odd_pictures) == ["IMG_12.png", "IMG_13.jpg"]
    assert film.focal_px == pytest.approx(26 * 50 / 43.27)


def test_a_damaged_film_is_read_past_its_damage_and_counts_what_is_lost(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (96, 128, 3), np.uint8) for _ in range(12)]
    path = films.write_film(tmp_path / "a.mp4", pictures)
    whole = Film(path)
    stamps = [frame.stamp_ns for frame in whole]
    assert len(stamps) == 12 and whole.unread == 0
    data = bytearray(path.read_bytes())
    start, size = films.box(bytes(data), b"mdat")
    middle = start + size // 2
    data[middle : middle + size // 6] = bytes(size // 6)
    path.write_bytes(bytes(data))
    film = Film(path)
    frames = list(film)
    assert 6 <= len(frames) < 12 and film.unread == 12 - len(frames)
    assert frames[-1].stamp_ns == stamps[-1] and {frame.stamp_ns for frame in frames} <= set(stamps)


def test_the_look_measures_motion_and_finds_blurred_and_dark_frames(tmp_path: Path) -> None:
    pictures = [card(2 * n) for n in range(12)]
    pictures[5] = np.asarray(cv2.GaussianBlur(pictures[5], (0, 0), 5), np.uint8)
    pictures[8] = np.full_like(pictures[8], 3)
    look = look_through(Film(films.write_film(tmp_path / "a.avi", pictures)), lambda _: None)
    assert np.flatnonzero(look.blurred).tolist() == [5] and np.flatnonzero(look.dark).tolist() == [8]
    assert look.motion[1:4] == pytest.approx(2 / 128, rel=0.3)


def test_of_each_step_of_motion_the_sharpest_frame_is_picked_and_straight_ahead_the_edges_tell_the_step() -> None:
    def look(motion: float, fast: float, count: int) -> FilmLook:
        sharpness = np.resize([1.0, 1.1, 1.0, 1.0, 1.0, 1.2, 1.0, 1.0], count)
        number, same = np.arange(count), np.full(count, motion)
        return FilmLook(number, number * 33_000_000, same, np.full(count, fast), sharpness, np.zeros(count, np.bool_))

    assert pick_frames(look(0.011, 0.011, 8)).tolist() == [1, 5] and pick_frames(look(0.0, 0.0, 8)).tolist() == [5]
    sideways, ahead = look(0.01, 0.01, 41), look(0.01, 0.03, 41)
    assert len(pick_frames(sideways)) == 11 and len(pick_frames(ahead)) == 23
