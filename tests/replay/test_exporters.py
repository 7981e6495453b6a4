"""Logs in formats of other programs, read back by what reads these formats."""

import dataclasses
import json
from base64 import b64decode
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import mcap.reader
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from semantic_mapper.errors import ConfigError, ImportSourceError, LogError, MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.replay.exporters import LogExportReport, export_log, log_format_of
from semantic_mapper.replay.importers.run import import_recording
from semantic_mapper.replay.importers.tum import read_trajectory
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.replay.run_folder import is_log
from semantic_mapper.transport.codec import encode_frame
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import PosedFrame
from tests.transport import samples

LABELS = LabelSet(
    "Lab 7", tuple(range(1, 41)), tuple(f"thing {i}" for i in range(40)), tuple((9, i, 200) for i in range(40))
)
PACKING = (CodecOptions(), CodecOptions(rgb="raw"), CodecOptions(rgb="jpeg"))


def turned(seq: int, **changes: Any) -> PosedFrame:
    """A frame with a pose that has all its digits."""
    frame = samples.make_frame(seq)
    T = frame.T_world_camera.copy()
    T[:3, :3] = Rotation.from_rotvec((0.1 * seq, -0.7, 0.3)).as_matrix()
    return dataclasses.replace(frame, T_world_camera=T, **{"stamp_ns": 10**18 + 33_333_333 * seq, **changes})


def write_log(path: Path, frames: list[PosedFrame], packing: tuple[CodecOptions, ...] = PACKING) -> Path:
    cameras = {frame.camera_id: samples.INTRINSICS for frame in frames}
    with LogWriter(path, StreamInfo("test", cameras, LABELS, metadata={"place": "lab"})) as log:
        for i, frame in enumerate(frames):
            log.write_parts(encode_frame(frame, packing[i % len(packing)]))
    return path


def exported(log: Path, out: Path, name: str | None = None, **more: Any) -> LogExportReport:
    with LogReader(log) as reader:
        return export_log(reader, out, log_format_of(out, name), **more)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log.mcap", [turned(seq) for seq in range(7)])


def test_a_sequence_folder_comes_back_bit_for_bit(log: Path, tmp_path: Path) -> None:
    report = exported(log, tmp_path / "sequence")
    assert (report.frames, report.left_out, report.notices) == (7, (), ())
    back = import_recording(tmp_path / "sequence", tmp_path / "back.mcap")
    assert (back.format, back.frames, back.labelled, back.skipped) == ("folder", 7, 7, [])
    with LogReader(log) as one, LogReader(tmp_path / "back.mcap") as other:
        assert other.info.label_set is not None and other.info.label_set.colors == LABELS.colors
        assert (other.info.label_set.ids, other.info.label_set.names) == (LABELS.ids, LABELS.names)
        for a, b in zip(one, other, strict=True):
            assert (a.stamp_ns, a.seq, a.intrinsics) == (b.stamp_ns, b.seq, b.intrinsics)
            assert a.T_world_camera.tobytes() == b.T_world_camera.tobytes() and np.array_equal(a.rgb, b.rgb)
            assert a.depth_m is not None and b.depth_m is not None and a.depth_m.tobytes() == b.depth_m.tobytes()
            assert a.label is not None and b.label is not None and np.array_equal(a.label, b.label)
        kept = [(e.rgb_encoding, parts[2]) for e, parts in one.frame_parts()]
        for (encoding, data), (e, parts) in zip(kept, other.frame_parts(), strict=True):
            if encoding != "raw":
                assert (e.rgb_encoding, parts[2]) == (encoding, data)  # the very file


def test_a_log_without_metres_stays_one(tmp_path: Path) -> None:
    info = StreamInfo("film", {"cam": samples.INTRINSICS}, metadata={SCALE_KEY: SCALE_UNKNOWN})
    with LogWriter(tmp_path / "log.mcap", info) as writer:
        for seq in range(3):
            writer.write_frame(turned(seq))
    report = exported(tmp_path / "log.mcap", tmp_path / "sequence")
    assert report.notices[-1] == "scale: unknown; lengths are not metres"
    import_recording(tmp_path / "sequence", tmp_path / "back.mcap")
    with LogReader(tmp_path / "back.mcap") as back:
        assert not back.info.scale_known
    exported(tmp_path / "log.mcap", tmp_path / "path.txt")
    assert (tmp_path / "path.txt").read_text().startswith("# scale: unknown\n# timestamp")
    with pytest.raises(MapError, match=r"TUM.*needs metres"):
        exported(tmp_path / "log.mcap", tmp_path / "tum", "tum")
    assert not (tmp_path / "tum").exists()


def test_what_a_sequence_folder_cannot_hold_is_told(tmp_path: Path) -> None:
    odd = np.full((18, 24), 1.00026, np.float32)
    other = dataclasses.replace(samples.INTRINSICS, fx=99.0)
    frames = [turned(0), turned(1, depth_m=None), turned(2, depth_m=odd), turned(3, stamp_ns=5)]
    frames.append(turned(4, intrinsics=other))
    report = exported(write_log(tmp_path / "log.mcap", frames), tmp_path / "sequence")
    assert report.frames == 3
    assert "seq=3" in report.left_out[0] and "not later" in report.left_out[0]
    assert "seq=4" in report.left_out[1] and "other intrinsics" in report.left_out[1]
    assert "off by up to 0.26 mm" in report.notices[0] and "1 frames have no depth" in report.notices[1]
    back = import_recording(tmp_path / "sequence", tmp_path / "back.mcap")
    assert back.frames == 3
    with LogReader(tmp_path / "back.mcap") as reader:
        depths = [frame.depth_m for frame in reader]
    assert depths[1] is not None and not depths[1].any() and depths[2] is not None
    np.testing.assert_allclose(depths[2], odd, atol=6e-4)


def test_tum_sequence_and_trajectory(log: Path, tmp_path: Path) -> None:
    report = exported(log, tmp_path / "desk", "tum")
    assert report.frames == 7 and not report.notices
    assert exported(log, tmp_path / "poses.txt").frames == 7
    assert (tmp_path / "poses.txt").read_text() == (tmp_path / "desk" / "groundtruth.txt").read_text()
    stamps, rows, left_out = read_trajectory(tmp_path / "poses.txt")
    back = import_recording(tmp_path / "desk", tmp_path / "back.mcap")
    assert (back.format, back.frames, back.skipped, left_out) == ("tum", 7, [], [])
    with LogReader(log) as one, LogReader(tmp_path / "back.mcap") as other:
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert a.stamp_ns == b.stamp_ns == stamps[i] and np.array_equal(a.rgb, b.rgb)
            assert a.depth_m is not None and b.depth_m is not None and a.depth_m.tobytes() == b.depth_m.tobytes()
            np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=1e-14)
            np.testing.assert_allclose(rows[i, :3], a.T_world_camera[:3, 3], rtol=0)


def test_foxglove_file_is_what_the_schemas_say_and_sends_its_reader_to_the_log(tmp_path: Path) -> None:
    odd = np.full((18, 24), 1.00026, np.float32)
    frames = [turned(0), turned(1, camera_id="left"), turned(2, depth_m=odd, label=None), turned(3, depth_m=None)]
    path = tmp_path / "foxglove.mcap"
    assert exported(write_log(tmp_path / "log.mcap", frames), path).frames == 4
    by_topic: dict[str, list[dict[str, Any]]] = {}
    types = {"object": dict, "string": str, "integer": int, "array": list, "number": float}
    with path.open("rb") as file:
        for schema, channel, read in mcap.reader.make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
            described, message = json.loads(schema.data), json.loads(read.data)
            assert set(message) == set(described["properties"]) and described["title"] == schema.name
            assert read.log_time == message["timestamp"]["sec"] * 10**9 + message["timestamp"]["nsec"]
            for name, value in described["properties"].items():
                assert isinstance(message[name], types[value["type"]]), name
                assert (value.get("contentEncoding") == "base64") == (name == "data")
            by_topic.setdefault(channel.topic, []).append(message)
    kinds = [f"/{camera}/{kind}" for camera in ("front", "left") for kind in ("rgb", "depth", "labels", "calibration")]
    assert set(by_topic) == {"/tf", *kinds}
    assert frames[0].depth_m is not None and frames[1].label is not None
    for topic, rgb in (("/front/rgb", frames[0].rgb), ("/left/labels", LABELS.colorize(frames[1].label))):
        pixels = cv2.imdecode(np.frombuffer(b64decode(by_topic[topic][0]["data"]), np.uint8), cv2.IMREAD_COLOR)
        assert by_topic[topic][0]["format"] == "png" and np.array_equal(pixels[..., ::-1], rgb)
    mm, metres = by_topic["/front/depth"]
    assert (mm["encoding"], mm["step"]) == ("16UC1", 48) and (metres["encoding"], metres["step"]) == ("32FC1", 96)
    units = np.frombuffer(b64decode(mm["data"]), "<u2").reshape(18, 24)
    assert np.array_equal(units.astype(np.float32) / np.float32(1000), frames[0].depth_m)
    assert np.array_equal(np.frombuffer(b64decode(metres["data"]), "<f4").reshape(18, 24), odd)
    calibration = by_topic["/left/calibration"][0]
    assert calibration["K"] == [20.5, 0, 11.5, 0, 21.0, 8.5, 0, 0, 1] and len(calibration["P"]) == 12
    with pytest.raises(ImportSourceError, match=r"for Foxglove.*use the log"):
        import_recording(path, tmp_path / "back.mcap")
    with pytest.raises(LogError, match=r"for Foxglove.*use the log"):
        LogReader(path)
    with pytest.raises(ImportSourceError, match="is a log already; replay it as it is"):
        import_recording(tmp_path / "log.mcap", tmp_path / "back.mcap")


def test_one_camera_of_several(tmp_path: Path) -> None:
    frames = [turned(seq, camera_id=("front", "left")[seq % 2]) for seq in range(8)]
    log = write_log(tmp_path / "log.mcap", frames)
    for name, camera in (("tum", ""), ("folder", ""), ("trajectory", ""), ("tum", "right")):
        with pytest.raises(ConfigError, match="name one camera of the log with --camera: front, left"):
            exported(log, tmp_path / "out", name, camera=camera)
    assert exported(log, tmp_path / "out", "tum", camera="left", max_frames=3).frames == 3
    stamps = read_trajectory(tmp_path / "out" / "groundtruth.txt")[0]
    assert stamps.tolist() == [frames[i].stamp_ns for i in (1, 3, 5)]


def test_what_cannot_be_written_is_refused_and_what_is_damaged_left_out(log: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    before = log.read_bytes()
    for out, name, error, message in (
        (tmp_path / "there", "folder", LogError, "exists already"),
        (tmp_path / "there", "trajectory", LogError, "exists already"),
        (log, "foxglove", LogError, "exists already"),
        (tmp_path / "a.xyz", None, ConfigError, "names no format"),
        (tmp_path / "a.mcap", "glb", ConfigError, "names no format"),
        (tmp_path / "no" / "such", "tum", LogError, "cannot be written"),
    ):
        with pytest.raises(error, match=message):
            exported(log, out, name)
    same = write_log(tmp_path / "back.mcap", [turned(0, camera_id="x"), turned(1, stamp_ns=10**18, camera_id="x")])
    report = exported(same, tmp_path / "poses.tum")
    assert report.frames == 1 and "same time" in report.left_out[0]
    assert log.read_bytes() == before and is_log(log) and is_log(tmp_path) and not is_log(tmp_path / "map.npz")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["back.mcap", "log.mcap", "poses.tum", "there"]
    damaged = bytearray(before)
    damaged[len(damaged) // 2] ^= 0xFF
    log.write_bytes(damaged)
    assert exported(log, tmp_path / "sequence").frames == 6


def test_a_lerobot_dataset_holds_pictures_poses_and_labels_of_each_frame(tmp_path: Path) -> None:
    frames = [turned(seq, world=int(seq > 4), label=None if seq == 3 else turned(seq).label) for seq in range(70)]
    report = exported(write_log(tmp_path / "log.mcap", frames, PACKING[:2]), tmp_path / "set", "lerobot")
    assert report.frames == 70 and "1 of 70 frames have no labels" in report.notices[0] and "depth" in report.notices[1]
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pylist()
    info, stats = (json.loads((tmp_path / f"set/meta/{name}.json").read_text()) for name in ("info", "stats"))
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30 and table[0].keys() == info["features"].keys()
    camera = f"observation.images.{frames[0].camera_id}"
    for row, frame in zip(table, frames, strict=True):
        x, y, z, *turn = row["observation.state"]
        np.testing.assert_allclose((x, y, z), frame.T_world_camera[:3, 3], rtol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(turn).as_matrix(), frame.T_world_camera[:3, :3], atol=1e-6)
        assert (row["stamp_ns"], row["episode_index"], row["index"]) == (frame.stamp_ns, frame.world, frame.seq)
        assert row["timestamp"] == pytest.approx(row["frame_index"] / 30)
        label = cv2.imdecode(np.frombuffer(row["labels"]["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
        expected = np.full(label.shape, LABELS.ignore_id) if frame.label is None else frame.label
        np.testing.assert_array_equal(label, expected)
        picture = cv2.imdecode(np.frombuffer(row[camera]["bytes"], np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(picture[..., ::-1], frame.rgb)
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"], e["length"]) for e in episodes] == [(0, 5, 5), (5, 70, 65)]
    rgb = np.stack([frame.rgb for frame in frames]) / 255
    np.testing.assert_allclose(np.ravel(stats[camera]["mean"]), rgb.mean(axis=(0, 1, 2)), atol=0.01)
    np.testing.assert_allclose(np.ravel(stats[camera]["std"]), rgb.std(axis=(0, 1, 2)), atol=0.01)


@pytest.mark.skipif(find_spec("lerobot") is None, reason="lerobot is not installed")
def test_the_own_loader_of_lerobot_reads_it(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore

    frames = [turned(seq, world=int(seq > 4)) for seq in range(9)]
    exported(write_log(tmp_path / "log.mcap", frames, PACKING[:1]), tmp_path / "set", "lerobot")
    read = LeRobotDataset("here/set", root=tmp_path / "set")
    assert (len(read), read.num_episodes, read.fps, read[7]["task"]) == (9, 2, 30, "explore")
    np.testing.assert_array_equal((read[7]["labels"][0] * 255).round().numpy(), frames[7].label)
    picture = (read[7][f"observation.images.{frames[7].camera_id}"] * 255).round().numpy()
    np.testing.assert_array_equal(picture.transpose(1, 2, 0), frames[7].rgb)
