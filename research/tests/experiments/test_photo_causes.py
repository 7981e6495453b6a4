"""Causes put into pictures: what they change, and what of it is scored."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from research.experiments import kept_votes, open_set, photo_causes
from research.experiments.photo_causes import IN_BOTH, OF_RECORDINGS, OF_ROOMS, Other, Picture
from semantic_mapper.labels import ROOMS
from tests.small import tiny_frames


def test_every_change_leaves_a_picture_of_the_same_size_and_another_content() -> None:
    frame, rng = tiny_frames()[0], np.random.default_rng(0)
    depth = np.where(np.arange(96) < 9, 0, np.asarray(frame.depth_m) + 2).astype(np.float32)
    picture = Picture(frame.rgb.astype(np.float32), depth, np.asarray(frame.label))
    gains, light = np.array((1.1, 1.0, 0.9)), np.array((100.0, 40.0))
    other = Other(np.flip(picture.rgb, 1).copy(), np.flip(depth, 1).copy(), gains, light, ROOMS.ignore_id, rng)
    for name, change in (OF_ROOMS | OF_RECORDINGS | IN_BOTH).items():
        found = change(picture, other)
        assert [x.shape for x in found] == [x.shape for x in picture], name
        assert any(not np.array_equal(a, b) for a, b in zip(found[:2], picture[:2], strict=True)), name
        assert np.isfinite(found.rgb).all() and (found.depth >= 0).all(), name
        ignored = found.label != picture.label
        assert (found.label[ignored] == ROOMS.ignore_id).all() and ignored.any() == name.startswith("12 patches"), name
        assert ((found.depth == 0) >= (depth == 0)).all() or name.startswith("holes filled"), name


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    for name in ("val-0", "val-1", "kitchen"):
        kept_votes.keep(folder / f"{name}.npz", tiny_frames(2), ROOMS, "")
    return folder


def rows_of(main: Callable[[], None], arguments: list[str], capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["", *arguments])
        main()
    return [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]


def test_causes_are_shown_of_rooms_and_of_a_recording(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(
        photo_causes.main, [str(kept), "val", "kitchen", "--only", "no depth", "grey", "--rooms", "2"], capsys
    )
    names = [row[0] for row in rows]
    assert names[:2] == ["val, 4 pictures", "as it is"] and "no depth beyond 3.5 m" in names
    assert names.count("no depth") == 2
    assert all("(" in row[2] for row in rows if row[0] == "no depth")


def test_maps_of_kept_frames_are_scored_by_temperature_and_threshold(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(kept_votes.load(kept / "kitchen.npz", every=2).frames) == 1
    rows = rows_of(open_set.main, ["kept", str(kept), "kitchen", "val/2", "--plot", str(tmp_path / "p.png")], capsys)
    assert all(len(row) == 3 for row in rows) and cv2.imread(str(tmp_path / "p.png")) is not None
    by_name = {row[0]: row[1:] for row in rows}
    assert len({by_name[f"{t:g}"][0] for t in open_set.TEMPERATURES}) > 1, "a temperature changes the ECE"
    known_kept = [float(by_name[f"{t:g}"][0].split(";")[0]) for t in open_set.THRESHOLDS]
    assert known_kept[0] == 100 and sorted(known_kept, reverse=True) == known_kept
