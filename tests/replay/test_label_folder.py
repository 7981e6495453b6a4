"""Folders of label images of a log's frames."""

import dataclasses
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, ImportSourceError, LabelError, LogError
from semantic_mapper.labels import ROOMS, LabelSet, make_label_set
from semantic_mapper.replay.label_folder import log_identity, make_label_folder, open_label_folder, read_classes
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame
from tests.small import INTRINSICS, tiny_frames

PAINTED = np.zeros((72, 96), np.uint8)
PAINTED[3:9, 4:40] = ROOMS.id_of("floor")


def write(path: Path, frames: tuple[PosedFrame, ...], label_set: LabelSet | None = ROOMS) -> Path:
    with LogWriter(path, StreamInfo(source="test", cameras={"rooms": INTRINSICS}, label_set=label_set)) as writer:
        for frame in frames:
            writer.write_frame(frame)
    return path


@pytest.fixture
def log(tmp_path: Path) -> Iterator[LogReader]:
    with LogReader(write(tmp_path / "room.mcap", tiny_frames(4))) as opened:
        yield opened


def test_what_is_written_comes_back_as_the_label_of_its_frame(log: LogReader, tmp_path: Path) -> None:
    made = make_label_folder(tmp_path / "labels", log, ROOMS)
    made.write(2, PAINTED)
    there = open_label_folder(tmp_path / "labels", log)
    assert there.numbers() == [2] and there.label_set == ROOMS and there.label_set.colors == ROOMS.colors
    frame = there.labelled(dataclasses.replace(log.frame(2), label_is_pseudo=True), 2)
    assert frame.label is not None and (frame.label == PAINTED).all() and not frame.label_is_pseudo
    with pytest.raises(LogError, match=r"no label image of frame 1, 000001\.png"):
        there.read(1, (72, 96))
    with pytest.raises(LogError, match="96x72"):
        there.read(2, (36, 48))
    with pytest.raises(LabelError, match=r"class ids \[99, 101\]"):
        made.write(2, PAINTED + np.uint8(99))
    assert (there.read(2, (72, 96)) == PAINTED).all(), "a refused one leaves the old one"
    made.write(2, PAINTED * 0)
    assert there.numbers() == []


def test_a_folder_is_of_one_log_whatever_that_is_called(log: LogReader, tmp_path: Path) -> None:
    make_label_folder(tmp_path / "labels", log, ROOMS).write(0, PAINTED)
    with LogReader(write(tmp_path / "renamed.mcap", tiny_frames(4))) as same:
        assert open_label_folder(tmp_path / "labels", same).numbers() == [0]
        assert make_label_folder(tmp_path / "labels", same, ROOMS).numbers() == [0]
        assert log_identity(same) != log_identity(log), "its name"
    moved = tuple(dataclasses.replace(f, T_world_camera=f.T_world_camera + np.eye(4, k=3)) for f in tiny_frames(4))
    for name, frames in (("other", tiny_frames(4, seed=3)), ("moved", moved), ("short", tiny_frames(3))):
        with LogReader(write(tmp_path / f"{name}.mcap", frames)) as other:
            for use in (open_label_folder, partial(make_label_folder, label_set=ROOMS)):
                with pytest.raises(LogError, match=r"labels of another log, renamed\.mcap \(4 frames\)"):
                    use(tmp_path / "labels", other)


def test_classes_may_be_added_but_not_changed(log: LogReader, tmp_path: Path) -> None:
    few, more = make_label_set("mine", ["mug", "desk"]), make_label_set("mine", ["mug", "desk", "plant"])
    make_label_folder(tmp_path / "labels", log, few).write(1, np.full((72, 96), 2, np.uint8))
    assert make_label_folder(tmp_path / "labels", log, more).label_set.names == ("mug", "desk", "plant")
    assert open_label_folder(tmp_path / "labels", log).label_set.names == more.names
    for other in (few, make_label_set("mine", ["mug", "chair", "plant"]), dataclasses.replace(more, ignore_id=255)):
        with pytest.raises(LabelError, match="labels of other classes"):
            make_label_folder(tmp_path / "labels", log, other)


def test_what_nobody_can_know_is_refused(log: LogReader, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    with pytest.raises(LogError, match="has no label images"):
        open_label_folder(images, log)
    cv2.imwrite(str(images / "000001.png"), PAINTED)
    assert open_label_folder(images, log).label_set == ROOMS, "those of the log"
    with pytest.raises(LogError, match=r"no labels\.json"):
        make_label_folder(images, log, ROOMS)
    with (
        LogReader(write(tmp_path / "plain.mcap", tiny_frames(2), None)) as plain,
        pytest.raises(LabelError, match=r"no labels\.json"),
    ):
        open_label_folder(images, plain)
    cv2.imwrite(str(images / "000004.png"), PAINTED)
    with pytest.raises(LogError, match=r"labels of frame 4, and .* has 4 frames"):
        open_label_folder(images, log)
    (images / "labels.json").write_text('{"classes": 3}')
    with pytest.raises(ImportSourceError, match=r"labels\.json"):
        open_label_folder(images, log)
    (images / "file").write_text("")
    with pytest.raises(ConfigError, match="choose another folder"):
        make_label_folder(images / "file" / "labels", log, ROOMS)


def test_classes_come_from_a_text_or_a_labels_json(tmp_path: Path) -> None:
    text = tmp_path / "kitchen.txt"
    text.write_text("mug\n# a comment\n\n  desk \n", encoding="utf-8")
    assert read_classes(text) == make_label_set("kitchen", ["mug", "desk"])
    plain = tmp_path / "labels.json"
    plain.write_text(json.dumps({"classes": {"4": "mug", "9": "desk"}, "ignore": 255}))
    assert (read_classes(plain).ids, read_classes(plain).ignore_id) == ((4, 9), 255)
    for wrong, error, says in (
        (b"mug\nmug\n", LabelError, "twice"),
        (b"", LabelError, "no classes"),
        (b"\xff\xfe", ConfigError, r"kitchen\.txt"),
    ):
        text.write_bytes(wrong)
        with pytest.raises(error, match=says):
            read_classes(text)
