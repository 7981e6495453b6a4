from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from research.experiments import odometry
from research.scenes import TRAIN_SEEDS, CameraPathConfig, room_frames
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

INTRINSICS = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)


def test_a_log_is_followed_judged_drawn_and_written_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, config = tmp_path / "room.mcap", tmp_path / "odometry.toml"
    config.write_text("loop_closure = false\n", encoding="utf-8")
    with LogWriter(log, StreamInfo("room", {"rooms": INTRINSICS}, label_set=ROOMS)) as writer:
        for frame in room_frames(TRAIN_SEEDS[7], 12, INTRINSICS, path=CameraPathConfig(step_m=0.04)):
            writer.write_frame(frame)
    names = {name: tmp_path / name for name in ("path.png", "new.mcap", "figures.json")}
    arguments = ["--picture", names["path.png"], "--write", names["new.mcap"], "--json", names["figures.json"]]
    monkeypatch.setattr("sys.argv", ["odometry.py", str(log), "--config", str(config), *map(str, arguments)])
    odometry.main()
    figures = json.loads(names["figures.json"].read_text(encoding="utf-8"))
    assert json.loads(capsys.readouterr().out) == figures
    assert figures["frames"] == figures["tracked"] == 12 and figures["ate_m"]["rmse_m"] < 0.01
    assert figures["path_m"] > 0.2 and figures["clock_ms"]["p50"] > 0
    picture = cv2.imread(str(names["path.png"]))
    assert picture is not None and picture.shape == (760, 900, 3)
    with LogReader(log) as before, LogReader(names["new.mcap"]) as after:
        assert len(after) == 12
        first, last = after.frame(0), after.frame(11)
        assert (last.T_world_camera == first.T_world_camera).mean() < 0.9
        assert first.pose_source == "odometry" and last.pose_sigma > 0
        assert (first.T_world_camera == before.frame(0).T_world_camera).all()
        assert (last.rgb == before.frame(11).rgb).all()
