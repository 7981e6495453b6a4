"""``autolabel``: what it writes and keeps, that nobody scores on it, and what it does about bad input."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import LogError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.imaging import is_measured
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.labelling import choose_keyframes
from semantic_mapper.replay.autolabel import AutolabelReport, AutolabelRequest, autolabel_log
from semantic_mapper.replay.autolabel_note import AutolabelNote, read_note
from semantic_mapper.replay.exporters import export_log
from semantic_mapper.replay.importers.run import import_recording
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.format import LogAttachment, LogReader, LogWriter
from semantic_mapper.replay.log.recording import Recording, RecordingRules
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.map_log import OFFLINE
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import Status, StreamInfo
from semantic_mapper.types import PosedFrame
from tests.nodes.support import refused, run, run_ok, summary_of, write_log, write_weights
from tests.small import INTRINSICS, tiny_config, tiny_field, tiny_frames

CALIBRATION = LogAttachment("calibration.json", "application/json", b'{"lens": 1}')
STATUS = Status("camera", "running", 5, {"frames": 3})


class StopsAfter(JobMonitor):
    """Asks for an end after so many frames."""

    def __init__(self, frames: int) -> None:
        self.left = frames

    @property
    def stopped_by(self) -> str:
        return "" if self.left > 0 else "SIGINT"

    def set(self, done: int, note: str = "") -> None:
        self.left -= 1


def relabelled(log: Path, out: Path, weights: Path, **options: Any) -> AutolabelReport:
    return autolabel_log(AutolabelRequest((log,), out, weights, tiny_config(), **options))


def read(log: Path) -> tuple[list[PosedFrame], AutolabelNote]:
    """All frames, and what is noted of their labels."""
    with LogReader(log) as opened:
        note = read_note(opened.attachments())
        assert note is not None and not opened.errors
        return list(opened), note


def same_labels(one: PosedFrame, other: PosedFrame) -> bool:
    return one.label_is_pseudo == other.label_is_pseudo and np.array_equal(one.label, other.label)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def part_labelled(folder: Path) -> Path:
    """Six frames, the first two with labels; JPEG images, a status, a calibration."""
    path = folder / "part-labelled.mcap"
    info = StreamInfo("test room", {"rooms": INTRINSICS}, ROOMS, metadata={"place": "lab"})
    with LogWriter(path, info, attachments=(CALIBRATION,)) as log:
        for i, frame in enumerate(tiny_frames(6)):
            frame = frame if i < 2 else replace(frame, label=None)
            log.write_parts(encode_frame(frame, CodecOptions(rgb="jpeg")))
            log.write_parts(encode(STATUS))
    return path


@pytest.fixture(scope="module")
def new(folder: Path, part_labelled: Path, weights: Path) -> Path:
    """What the verb makes of it; its JSON is beside it."""
    out = folder / "new.mcap"
    done = run_ok("autolabel", part_labelled, "--weights", weights, "--out", out, "--json")
    out.with_suffix(".json").write_text(done.stdout)
    return out


def test_all_but_the_labels_stays_byte_for_byte(new: Path, part_labelled: Path) -> None:
    with LogReader(part_labelled) as old_log, LogReader(new) as new_log:
        assert new_log.attachments()["calibration.json"] == CALIBRATION
        assert new_log.info == old_log.info
        old, found = list(old_log.messages()), list(new_log.messages())
        assert [envelope.topic for envelope, _ in old] == [envelope.topic for envelope, _ in found]
        for (envelope, parts), (other, other_parts) in zip(old, found, strict=True):
            if envelope.topic == "status":
                assert other_parts == parts
            if envelope.topic == "frame":
                assert (other.stamp_ns, other.seq, other.source) == (envelope.stamp_ns, envelope.seq, envelope.source)
                assert other.T_world_camera == envelope.T_world_camera
                assert other_parts[2:4] == parts[2:4]  # the very JPEG file, and depth


def test_labels_stay_and_missing_ones_are_those_that_replay_renders(
    new: Path, part_labelled: Path, weights: Path
) -> None:
    frames, note = read(new)
    assert [f.label_is_pseudo for f in frames] == [False, False, True, True, True, True]
    assert (note.frames, note.labelled, note.kept, note.replaced) == (6, 4, 2, 0)
    mapper = Mapper.load(weights, load_mapper_config(None, defaults=OFFLINE))
    with LogReader(part_labelled) as log:
        for frame, other in zip(log, frames, strict=True):
            rendered = mapper.step(frame).label
            assert np.array_equal(other.label, rendered if other.label_is_pseudo else frame.label)  # type: ignore[arg-type]
    said = json.loads(new.with_suffix(".json").read_text())
    assert said["labelled"] == 4 and said["files"] == [str(new)] and said["kind"] == "sray"
    assert 0 < said["mean_confidence"] <= 1 and 0 < said["labelled_pixels"] <= 1
    shown = run("info", new).stdout
    assert "tiny.safetensors (sray, SHA-256" in shown and "4 with pseudo labels" in shown
    told = json.loads(run("info", new, "--json").stdout)
    assert (told["frames_with_labels"], told["frames_with_pseudo_labels"]) == (2, 4)
    assert told["autolabel"]["labelled"] == 4 and len(told["autolabel"]["digest"]) == 64


def test_pixels_that_are_not_sure_are_unknown(part_labelled: Path, weights: Path, tmp_path: Path) -> None:
    for name in ("all.mcap", "again.mcap"):
        relabelled(part_labelled, tmp_path / name, weights)
    assert (tmp_path / "all.mcap").read_bytes() == (tmp_path / "again.mcap").read_bytes()
    frames, note = read(tmp_path / "all.mcap")
    assert note.mean_confidence is not None and note.labelled_pixels is not None
    relabelled(part_labelled, tmp_path / "sure.mcap", weights, min_confidence=note.mean_confidence)
    sure, kept = read(tmp_path / "sure.mcap")
    everything, some = frames[3].label, sure[3].label
    assert everything is not None and some is not None
    unknown = some == ROOMS.ignore_id
    assert 0 < unknown.mean() < 1 and np.array_equal(some[~unknown], everything[~unknown])
    assert (kept.mean_confidence or 0) > note.mean_confidence and (kept.labelled_pixels or 1) < note.labelled_pixels
    report = relabelled(part_labelled, tmp_path / "none.mcap", weights, min_confidence=1.0)
    assert report.note.labelled == 0 and report.note.unlabelled == 4  # no label rather than one of nothing
    assert [f.label is not None for f in read(tmp_path / "none.mcap")[0]] == [True, True, False, False, False, False]


def test_pseudo_labels_are_replaced_and_labels_of_people_only_on_request(new: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    save_checkpoint(Checkpoint(tiny_field(seed=5), (), {"width": 96}), other)
    relabelled(new, tmp_path / "again.mcap", other)
    after, note = read(tmp_path / "again.mcap")
    assert (note.kept, note.labelled, note.weights) == (2, 4, "other.safetensors")
    assert [same_labels(a, b) for a, b in zip(read(new)[0], after, strict=True)] == [True] * 2 + [False] * 4
    relabelled(new, tmp_path / "forced.mcap", other, overwrite_labels=True)
    forced, note = read(tmp_path / "forced.mcap")
    assert (note.kept, note.labelled, note.replaced) == (0, 6, 2) and all(f.label_is_pseudo for f in forced)


def test_pseudo_labels_never_score(new: Path, part_labelled: Path, weights: Path, config: Path, tmp_path: Path) -> None:
    options, file, all_pseudo = ("--weights", weights, "--config", config), tmp_path / "eval.json", tmp_path / "a.mcap"
    said = run_ok("eval", new, *options, "--out", file).stdout
    scores = json.loads(file.read_text())["logs"][str(new)]
    assert (scores["scored"], scores["pseudo_labelled"]) == (2, 4) and "4 with pseudo labels" in said
    run_ok("eval", part_labelled, *options, "--out", file)
    assert json.loads(file.read_text())["logs"][str(part_labelled)]["methods"] == scores["methods"]
    relabelled(new, all_pseudo, weights, overwrite_labels=True)
    said = refused("eval", all_pseudo, *options, "--out", file)
    assert "all of its 6 label images are pseudo labels" in said and "tiny.safetensors has rendered" in said
    for log, scored in ((new, 2), (all_pseudo, 0)):
        said = run_ok("map", log, "--out", tmp_path / log.stem, *options).stdout
        summary = summary_of(tmp_path / log.stem)
        assert (summary["frames"]["scored"], summary["frames"]["pseudo_labels"]) == (scored, 6 - scored)
        assert (summary["metrics"]["miou"] is None) == (scored == 0)
        assert f"{6 - scored} frames not scored: their labels are pseudo labels" in said


def test_finetune_on_pseudo_labels_remembers_the_teachers_keyframes(part_labelled: Path, tmp_path: Path) -> None:
    stamps, student = [f.stamp_ns for f in tiny_frames(6)], tmp_path / "student.safetensors"
    teacher, start = write_weights(tmp_path / "teacher.safetensors", stamps[:2]), write_weights(tmp_path / "w")
    relabelled(part_labelled, tmp_path / "new.mcap", teacher)
    options = ("--keyframes", "4", "--seconds", "0", "--steps", "2", "--weights", start, "--out", student)
    said = run_ok("finetune", tmp_path / "new.mcap", *options).stdout
    assert "of the 4 keyframes have pseudo labels that teacher.safetensors has rendered" in said
    checkpoint = load_checkpoint(student)
    assert checkpoint.recipe["pseudo_labels"]["keyframes"] >= 2
    assert set(stamps[:2]) <= checkpoint.train_stamps_ns


def test_export_and_import_keep_pseudo_labels_apart(new: Path, tmp_path: Path) -> None:
    with LogReader(new) as log:
        report = export_log(log, tmp_path / "folder", "folder")
    assert any("4 label images are pseudo labels" in notice for notice in report.notices)
    assert [f.name for f in sorted((tmp_path / "folder" / "label").iterdir())] == ["000000.png", "000001.png"]
    assert len(list((tmp_path / "folder" / "pseudo_label").iterdir())) == 4
    back = import_recording(tmp_path / "folder", tmp_path / "back.mcap")
    assert back.labelled == 2 and any("4 frames with pseudo labels" in notice for notice in back.notices)
    (frames, note), (others, other_note) = read(new), read(tmp_path / "back.mcap")
    assert note == other_note and all(map(same_labels, frames, others))


def test_computed_depth_has_a_spread_and_never_passes_for_measured(weights: Path, config: Path, tmp_path: Path) -> None:
    frames = [replace(f, depth_m=None, label=None) for f in tiny_frames(6)]
    plain, deep = write_log(tmp_path / "plain.mcap", frames), tmp_path / "deep.mcap"
    settings = tiny_config(depth={"from_motion": {"delay_frames": 2}})
    report = autolabel_log(AutolabelRequest((plain,), deep, weights, settings, depth=True))
    assert report.note.depth_written > 2
    with LogReader(deep) as log:
        frames = [f for f in log if f.depth_m is not None]
        assert [e.seq for e, _ in log.frame_parts()] == list(range(6))  # in order, though frames wait for later ones
        export_log(log, tmp_path / "folder", "folder")
        tum = export_log(log, tmp_path / "tum", "tum")
    assert len(frames) > 2
    for frame in frames:
        assert frame.depth_sigma_m is not None and not is_measured(frame) and frame.depth_m is not None
        assert (frame.depth_sigma_m[frame.depth_m > 0] > 0).all()
    found = json.loads(run("info", deep, "--json").stdout)
    assert (found["frames_with_depth"], found["frames_with_computed_depth"]) == (0, len(frames))
    assert not (tmp_path / "folder" / "depth").exists() and not (tmp_path / "tum" / "depth").exists()
    assert any("computed, not a sensor's" in notice for notice in tum.notices)
    import_recording(tmp_path / "folder", tmp_path / "back.mcap")
    with LogReader(tmp_path / "back.mcap") as back:
        others = [f for f in back if f.depth_m is not None]
    for a, b in zip(frames, others, strict=True):
        assert np.array_equal(a.depth_m, b.depth_m) and np.array_equal(a.depth_sigma_m, b.depth_sigma_m)  # type: ignore[arg-type]
    for source, key in (("auto", "computed_fraction"), ("off", "rendered_fraction"), ("sensor", "rendered_fraction")):
        out, options = tmp_path / source, ("--weights", weights, "--config", config, "--depth", source)
        done = run("map", deep, "--out", out, *options)
        assert done.returncode == (0 if summary_of(out)["map"]["surface_points"] else 4), done.stderr
        assert summary_of(out)["depth"][key] == 1.0


def test_parts_stay_parts(weights: Path, tmp_path: Path) -> None:
    source, new = tmp_path / "source", tmp_path / "new"
    source.mkdir(), new.mkdir()
    encoded = [encode_frame(replace(f, label=None)) for f in tiny_frames(6)]
    rules = RecordingRules(split_bytes=2 * sum(map(len, encoded[0])))
    recording = Recording(source / "day.mcap", StreamInfo("room", {"rooms": INTRINSICS}), rules, recording="r1")
    for parts in encoded:
        recording.write(parts)
    recording.close()
    with open_log(source) as log:
        counts = [len(LogReader(part)) for part in log.paths]
    assert len(counts) > 1
    run_ok("autolabel", source, "--weights", weights, "--out", new / "day.mcap")
    with open_log(new) as log:
        made = [LogReader(part) for part in log.paths]
        assert [len(part) for part in made] == counts and not log.notices
        assert all(f.label_is_pseudo for f in log)
        notes = [read_note(part.attachments()) for part in made]
    assert notes[0] is not None and notes[0].frames == 6 and all(note == notes[0] for note in notes)
    said = refused("autolabel", source, "--weights", weights, "--out", source / "more.mcap")
    assert "would be read as one" in said


def test_other_classes_are_refused_unless_all_labels_go(weights: Path, tmp_path: Path) -> None:
    kitchen = make_label_set("kitchen", ["stove", "spoon"])
    frames = [replace(f, label=np.full((72, 96), kitchen.ids[0], np.uint8)) for f in tiny_frames(3)]
    command = ("autolabel", write_log(tmp_path / "log.mcap", frames, kitchen), "--weights", weights)
    out = tmp_path / "new.mcap"
    said = refused(*command, "--out", out)
    assert "'kitchen' (stove, spoon)" in said and "'rooms' (wall, floor" in said and not out.exists()
    run_ok(*command, "--out", out, "--overwrite-labels")
    with LogReader(out) as new:
        assert new.info.label_set == ROOMS


def test_the_same_classes_with_other_ids_become_the_logs_ids(weights: Path, tmp_path: Path) -> None:
    shifted = make_label_set("rooms+100", ROOMS.names, ids=[i + 100 for i in ROOMS.ids])
    label = np.full((72, 96), shifted.ids[0], np.uint8)
    frames = [replace(f, label=label if i == 0 else None) for i, f in enumerate(tiny_frames(3))]
    report = relabelled(write_log(tmp_path / "log.mcap", frames, shifted), tmp_path / "new.mcap", weights)
    assert (report.note.kept, report.note.labelled) == (1, 2)
    with LogReader(tmp_path / "new.mcap") as new:
        assert new.info.label_set == shifted
        for frame in new:
            shifted.to_channels(frame.label)


def test_what_is_damaged_is_left_out_and_named(part_labelled: Path, weights: Path, tmp_path: Path) -> None:
    data = bytearray(part_labelled.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    said = run_ok("autolabel", tmp_path / "damaged.mcap", "--weights", weights, "--out", tmp_path / "new.mcap").stdout
    frames, note = read(tmp_path / "new.mcap")
    assert "damaged, left out: " in said and len(frames) == note.frames == 5


def test_frames_that_cannot_be_rendered_stay_without_a_label(new: Path, weights: Path, tmp_path: Path) -> None:
    odd = np.eye(4)
    odd[0, 0] = 3.0
    bent = [replace(frame, T_world_camera=odd) for frame in read(new)[0]]
    some = [*read(new)[0][:4], bent[4], read(new)[0][5]]
    report = relabelled(write_log(tmp_path / "odd.mcap", some), tmp_path / "out.mcap", weights)
    assert len(report.unlabelled) == 1 and "rotation" in report.unlabelled[0]
    assert [f.label is None for f in read(tmp_path / "out.mcap")[0]] == [False] * 4 + [True, False], "the old one went"
    with pytest.raises(LogError, match="none of its 6 frames could be rendered"):
        relabelled(write_log(tmp_path / "all.mcap", bent), tmp_path / "none.mcap", weights)
    assert not (tmp_path / "none.mcap").exists()


def test_a_stop_leaves_nothing(log: Path, weights: Path, tmp_path: Path) -> None:
    request = AutolabelRequest((log,), tmp_path / "new.mcap", weights, tiny_config(), overwrite_labels=True)
    with pytest.raises(KeyboardInterrupt):
        autolabel_log(request, StopsAfter(2))
    assert list(tmp_path.iterdir()) == []


def test_label_images_of_a_person_take_the_mark_away(new: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "000003.png"), np.full((72, 96), ROOMS.ids[0], np.uint8))
    (own,) = choose_keyframes(new, 1, tmp_path, JobMonitor())[0].values()
    found = choose_keyframes(new, 6, None, JobMonitor())[0]
    assert not own.label_is_pseudo and found[3].label_is_pseudo
