"""What an import may change on the way: names of classes, and which way is up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import LabelError
from semantic_mapper.replay.importers import ImportOptions, import_recording
from semantic_mapper.replay.log.format import LogReader

from . import recordings as rec


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return rec.make_folder(tmp_path / "kitchen")


def test_classes_are_renamed_and_joined_on_the_way_in(folder: Path) -> None:
    dst = folder.parent / "log.mcap"
    report = import_recording(folder, dst, renames={"floor": "ground", "chair": "ground"})
    assert report.frames == report.labelled == 6
    log = LogReader(dst)
    assert log.info.label_set is not None
    assert dict(zip(log.info.label_set.names, log.info.label_set.ids, strict=True)) == {"wall": 1, "ground": 2}
    for i, frame in enumerate(log):
        assert frame.label is not None
        assert np.array_equal(frame.label, np.where(rec.label(i) == 5, 2, rec.label(i)))


def test_images_of_a_camera_on_its_side_are_turned_with_their_poses(folder: Path) -> None:
    dst = folder.parent / "turned.mcap"
    report = import_recording(folder, dst, options=ImportOptions(quarters=1))
    log = LogReader(dst)
    assert report.frames == 6 and not report.skipped
    assert (log.info.cameras["camera"].width, log.info.cameras["camera"].height) == (rec.HEIGHT, rec.WIDTH)
    import_recording(folder, folder.parent / "upright.mcap")
    upright = LogReader(folder.parent / "upright.mcap")
    for turned, frame in zip(log, upright, strict=True):
        assert turned.label is not None and frame.label is not None and turned.depth_m is not None
        assert np.array_equal(turned.rgb, np.rot90(frame.rgb, -1))
        assert np.array_equal(turned.label, np.rot90(frame.label, -1))
        assert turned.intrinsics == log.info.cameras["camera"]
        np.testing.assert_allclose(turned.T_world_camera[:3, 2], frame.T_world_camera[:3, 2])
        np.testing.assert_allclose(turned.T_world_camera[:3, 1], frame.T_world_camera[:3, 0])


def test_renaming_what_is_not_there_writes_nothing(folder: Path) -> None:
    dst = folder.parent / "log.mcap"
    with pytest.raises(LabelError, match="sofa"):
        import_recording(folder, dst, renames={"sofa": "couch"})
    (folder / "labels.json").unlink()
    with pytest.raises(LabelError, match="no labels"):
        import_recording(folder, dst, renames={"floor": "ground"})
    assert not dst.exists()
