"""A trajectory file moves the map of a session."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from structlog.testing import capture_logs

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.artifacts import finish_session
from semantic_mapper.replay.corrected_poses import correct_session, keeping_frames, read_corrections
from semantic_mapper.replay.session import MapSession
from semantic_mapper.types import Float64, PosedFrame
from tests.small import tiny_config, tiny_field, tiny_frames


def shifted(frames: tuple[PosedFrame, ...], metres: float) -> list[PosedFrame]:
    """As odometry with an offset gives them."""
    motion = np.eye(4)
    motion[0, 3] = metres
    return [replace(f, T_world_camera=motion @ f.T_world_camera) for f in frames]


def tum_line(stamp_ns: int, T: Float64) -> str:
    """With microseconds, as most tools write them."""
    numbers = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
    return f"{stamp_ns // 1000 / 1e6:.6f} " + " ".join(f"{n:.9f}" for n in numbers)


def write(path: Path, frames: tuple[PosedFrame, ...] | list[PosedFrame], *more: str) -> Path:
    lines = ["# stamp tx ty tz qx qy qz qw", *(tum_line(f.stamp_ns, f.T_world_camera) for f in frames), *more]
    path.write_text("\n".join(lines) + "\n")
    return path


def session_of(folder: Path, frames: list[PosedFrame], **changes: object) -> MapSession:
    save_checkpoint(Checkpoint(tiny_field(), (), {"kind": "test", "width": 96}), folder / "w.safetensors")
    config = keeping_frames(tiny_config(render={"encode_width": 96, "scale": 0.25}, **changes), len(frames))
    session = MapSession(Mapper.load(folder / "w.safetensors", config), stream_labels=ROOMS)
    for frame in frames:
        session.process(frame)
    return session


def test_the_map_and_the_truth_that_it_is_scored_against_move_with_the_trajectory(tmp_path: Path) -> None:
    frames = tiny_frames()
    session = session_of(tmp_path, shifted(frames, 0.5))
    trajectory = read_corrections(write(tmp_path / "true.txt", frames[::2]))
    before = session.pipeline.voxel_map.points().xyz
    assert correct_session(session, trajectory) == session.corrected_poses == 3
    after = session.pipeline.voxel_map.points().xyz
    for frame in frames:  # also the last one, which comes after the last pose of the file
        at = session.pipeline.corrector.poses()["rooms", frame.stamp_ns]
        np.testing.assert_allclose(at, frame.T_world_camera, atol=1e-6)
    np.testing.assert_allclose(np.median(before, axis=0) - np.median(after, axis=0), [0.5, 0, 0], atol=0.02)
    summary = finish_session(session, tmp_path / "out")
    straight = finish_session(session_of(tmp_path, list(frames)), tmp_path / "straight")
    assert summary["map"]["corrected_poses"] == 3 and straight["map"]["corrected_poses"] == 0
    assert summary["metrics"]["map_miou"] == pytest.approx(straight["metrics"]["map_miou"], abs=0.05)


def test_poses_without_a_frame_are_left_out_and_told_of(tmp_path: Path) -> None:
    frames = tiny_frames()
    session = session_of(tmp_path, list(frames))
    far = tum_line(frames[-1].stamp_ns + 10**9, frames[0].T_world_camera)
    with capture_logs() as logs:
        assert correct_session(session, read_corrections(write(tmp_path / "a.txt", frames[:2], far))) == 2
    assert [(e["left_out"], e["used"]) for e in logs if e["event"] == "corrections_without_a_frame"] == [(1, 2)]
    with pytest.raises(
        ImportSourceError, match=r"b\.txt: none of its 1 stamps .* first is 1\.4.* s, that of the frames 0\.06"
    ):
        correct_session(session, read_corrections(write(tmp_path / "b.txt", [], far)))


def test_what_cannot_correct_a_map_is_refused_by_name(tmp_path: Path) -> None:
    frames = tiny_frames(12)
    with pytest.raises(ImportSourceError, match=r"gone\.txt: cannot be read"):
        read_corrections(tmp_path / "gone.txt")
    with pytest.raises(ImportSourceError, match=r"a\.txt, line 4: .*1 lines"):
        read_corrections(write(tmp_path / "a.txt", frames[:2], "1.0 2 3"))
    trajectory = read_corrections(write(tmp_path / "a.txt", frames[:1]))
    session = session_of(tmp_path, [frames[0], replace(frames[1], camera_id="rear")])
    with pytest.raises(ImportSourceError, match="this log has rear, rooms"):
        correct_session(session, trajectory)
    session = session_of(tmp_path, list(frames), history={"max_frames": 4})
    with pytest.raises(ImportSourceError, match=r"; [1-9]\d* frames have left the history \(history\.max_frames"):
        correct_session(session, trajectory)
