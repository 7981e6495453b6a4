"""``autolabel``: what it writes and keeps, that nobody scores on it, and what it does about bad input."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import LogError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.imaging import is_measured
from semantic_mapper.labels import ROOMS, LabelSet, make_label_set
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.labelling import choose_keyframes
from semantic_mapper.replay.autolabel import AutolabelReport, AutolabelRequest, autolabel_log
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.exporters import export_log
from semantic_mapper.replay.importers import import_recording
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.jobs import OFFLINE
from semantic_mapper.replay.log.format import LogAttachment, LogReader, LogWriter
from semantic_mapper.replay.log.recording import Recording, RecordingRules
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import Status, StreamInfo
from semantic_mapper.types import PosedFrame
from tests.nodes.support import error_line, run, write_log, write_weights
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


def unlabelled(frames: tuple[PosedFrame, ...], labelled: int = 0) -> list[PosedFrame]:
    """Frames of which only the first few have labels."""
    return [f if i < labelled else dataclasses.replace(f, label=None) for i, f in enumerate(frames)]


def relabelled(log: Path, out: Path, weights: Path, **options: Any) -> AutolabelReport:
    request = AutolabelRequest((log,), out, weights, tiny_config(), **options)
    return autolabel_log(request)


@pytest.fixture(scope="module")
def part_labelled(folder: Path) -> Path:
    """Six frames, the first two with labels; JPEG images, a status, a calibration."""
    path = folder / "part-labelled.mcap"
    info = StreamInfo("test room", {"rooms": INTRINSICS}, ROOMS, metadata={"place": "lab"})
    with LogWriter(path, info, attachments=(CALIBRATION,)) as log:
        for frame in unlabelled(tiny_frames(6), 2):
            log.write_parts(encode_frame(frame, CodecOptions(rgb="jpeg")))
            log.write_parts(encode(STATUS))
    return path


@pytest.fixture(scope="module")
def new(folder: Path, part_labelled: Path, weights: Path) -> Path:
    """What the verb makes of it; its JSON is beside it."""
    out = folder / "new.mcap"
    done = run("autolabel", part_labelled, "--weights", weights, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
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


def test_labels_that_are_there_stay_and_others_are_marked(new: Path) -> None:
    with LogReader(new) as log:
        frames = list(log)
        note = read_note(log.attachments())
    assert [f.label_is_pseudo for f in frames] == [False, False, True, True, True, True]
    for frame, given in zip(frames[:2], tiny_frames(6), strict=False):
        assert frame.label is not None and np.array_equal(frame.label, given.label)
    assert note is not None and (note.frames, note.labelled, note.kept, note.replaced) == (6, 4, 2, 0)
    said = json.loads(new.with_suffix(".json").read_text())
    assert said["labelled"] == 4 and said["files"] == [str(new)] and said["kind"] == "sray"
    assert 0 < said["mean_confidence"] <= 1 and 0 < said["labelled_pixels"] <= 1


def test_labels_are_those_that_replay_renders(new: Path, part_labelled: Path, weights: Path) -> None:
    mapper = Mapper.load(weights, load_mapper_config(None, defaults=OFFLINE))
    with LogReader(part_labelled) as log, LogReader(new) as labelled:
        for frame, other in zip(log, labelled, strict=True):
            update = mapper.step(frame)
            if other.label_is_pseudo:
                assert np.array_equal(update.label, other.label)


def test_the_same_run_gives_the_same_bytes(part_labelled: Path, weights: Path, tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        relabelled(part_labelled, tmp_path / name, weights)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_info_says_who_has_labelled_a_log(new: Path) -> None:
    said = run("info", new).stdout
    assert "tiny.safetensors (sray, SHA-256" in said and "4 with pseudo labels" in said
    found = json.loads(run("info", new, "--json").stdout)
    assert (found["frames_with_labels"], found["frames_with_pseudo_labels"]) == (2, 4)
    assert found["autolabel"]["labelled"] == 4 and len(found["autolabel"]["digest"]) == 64


def test_pixels_that_are_not_sure_are_unknown(part_labelled: Path, weights: Path, tmp_path: Path) -> None:
    relabelled(part_labelled, tmp_path / "all.mcap", weights)
    with LogReader(tmp_path / "all.mcap") as log:
        note = read_note(log.attachments())
        everything = list(log)[3].label
    assert note is not None and note.mean_confidence is not None and everything is not None
    relabelled(part_labelled, tmp_path / "sure.mcap", weights, min_confidence=note.mean_confidence)
    with LogReader(tmp_path / "sure.mcap") as log:
        sure = list(log)[3].label
        kept = read_note(log.attachments())
    assert sure is not None and kept is not None and kept.mean_confidence is not None
    unknown = sure == ROOMS.ignore_id
    assert 0 < unknown.mean() < 1 and np.array_equal(sure[~unknown], everything[~unknown])
    assert kept.mean_confidence > note.mean_confidence
    assert kept.labelled_pixels is not None and note.labelled_pixels is not None
    assert kept.labelled_pixels < note.labelled_pixels
    report = relabelled(part_labelled, tmp_path / "none.mcap", weights, min_confidence=1.0)
    assert report.note.labelled == 0 and report.note.unlabelled == 4  # no label rather than one of nothing
    with LogReader(tmp_path / "none.mcap") as log:
        assert [f.label is not None for f in log] == [True, True, False, False, False, False]


def test_pseudo_labels_are_replaced_and_labels_of_people_only_on_request(
    new: Path, folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other.safetensors"
    save_checkpoint(Checkpoint(tiny_field(seed=5), (), {"width": 96}), other)
    again = relabelled(new, tmp_path / "again.mcap", other)
    assert (again.note.kept, again.note.labelled) == (2, 4)
    with LogReader(new) as before, LogReader(tmp_path / "again.mcap") as after:
        pairs = list(zip(before, after, strict=True))
        note = read_note(after.attachments())
    assert note is not None and note.weights == "other.safetensors"
    assert all(np.array_equal(a.label, b.label) for a, b in pairs[:2])
    assert not any(np.array_equal(a.label, b.label) for a, b in pairs[2:])
    forced = relabelled(new, tmp_path / "forced.mcap", other, overwrite_labels=True)
    assert (forced.note.kept, forced.note.labelled, forced.note.replaced) == (0, 6, 2)
    with LogReader(tmp_path / "forced.mcap") as log:
        assert all(f.label_is_pseudo for f in log)


def test_eval_never_scores_on_pseudo_labels(
    new: Path, weights: Path, config: Path, tmp_path: Path, part_labelled: Path
) -> None:
    file = tmp_path / "eval.json"
    done = run("eval", new, "--weights", weights, "--config", config, "--out", file)
    assert done.returncode == 0, done.stderr
    scores = json.loads(file.read_text())["logs"][str(new)]
    assert (scores["scored"], scores["pseudo_labelled"]) == (2, 4) and "4 with pseudo labels" in done.stdout
    source = tmp_path / "source.json"
    assert run("eval", part_labelled, "--weights", weights, "--config", config, "--out", source).returncode == 0
    assert json.loads(source.read_text())["logs"][str(part_labelled)]["methods"] == scores["methods"]
    relabelled(new, tmp_path / "all.mcap", weights, overwrite_labels=True)
    done = run("eval", tmp_path / "all.mcap", "--weights", weights, "--config", config, "--out", file)
    assert done.returncode == 1
    assert "there is no score: all of its 6 label images are pseudo labels" in error_line(done.stderr)
    assert "tiny.safetensors has rendered" in error_line(done.stderr)


def test_replay_never_scores_on_pseudo_labels(new: Path, weights: Path, config: Path, tmp_path: Path) -> None:
    relabelled(new, tmp_path / "all.mcap", weights, overwrite_labels=True)
    for log, scored in ((new, 2), (tmp_path / "all.mcap", 0)):
        out = tmp_path / log.stem
        done = run("replay", log, "--out", out, "--weights", weights, "--config", config)
        assert done.returncode == 0, done.stderr
        summary = json.loads((out / "summary.json").read_text())
        assert (summary["frames"]["scored"], summary["frames"]["pseudo_labels"]) == (scored, 6 - scored)
        assert (summary["metrics"]["miou"] is None) == (scored == 0)
        assert f"{6 - scored} frames not scored: their labels are pseudo labels" in done.stdout


def test_finetune_learns_from_pseudo_labels_says_so_and_remembers_the_teachers_keyframes(
    new: Path, part_labelled: Path, folder: Path, tmp_path: Path
) -> None:
    stamps = [f.stamp_ns for f in tiny_frames(6)]
    teacher = write_weights(tmp_path / "teacher.safetensors", stamps[:2])
    relabelled(part_labelled, tmp_path / "new.mcap", teacher)
    student = tmp_path / "student.safetensors"
    options = (
        "--keyframes",
        "4",
        "--seconds",
        "0",
        "--steps",
        "2",
        "--weights",
        write_weights(tmp_path / "w.safetensors"),
    )
    done = run("finetune", tmp_path / "new.mcap", *options, "--out", student)
    assert done.returncode == 0, done.stderr
    assert "of the 4 keyframes have pseudo labels that teacher.safetensors has rendered" in done.stdout
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
    with LogReader(new) as one, LogReader(tmp_path / "back.mcap") as other:
        assert read_note(other.attachments()) == read_note(one.attachments()) is not None
    assert back.labelled == 2 and any("4 frames with pseudo labels" in notice for notice in back.notices)
    with LogReader(new) as one, LogReader(tmp_path / "back.mcap") as other:
        for a, b in zip(one, other, strict=True):
            assert a.label_is_pseudo == b.label_is_pseudo and np.array_equal(a.label, b.label)


def without_depth(path: Path, frames: tuple[PosedFrame, ...]) -> Path:
    return write_log(path, [dataclasses.replace(f, depth_m=None, label=None) for f in frames])


@pytest.fixture(scope="module")
def with_depth(folder: Path, weights: Path) -> Path:
    """A log without depth, labelled with ``--depth``."""
    plain = without_depth(folder / "plain.mcap", tiny_frames(6))
    request = AutolabelRequest(
        (plain,), folder / "deep.mcap", weights, tiny_config(depth={"from_motion": {"delay_frames": 2}}), depth=True
    )
    report = autolabel_log(request)
    assert report.note.depth_written > 2
    return folder / "deep.mcap"


def test_computed_depth_has_its_spread_and_never_passes_for_measured(with_depth: Path, tmp_path: Path) -> None:
    with LogReader(with_depth) as log:
        frames = [f for f in log if f.depth_m is not None]
        assert [e.seq for e, _ in log.frame_parts()] == list(range(6))  # in order, though frames wait for later ones
        export_log(log, tmp_path / "folder", "folder")
        tum = export_log(log, tmp_path / "tum", "tum")
    assert len(frames) > 2
    for frame in frames:
        assert frame.depth_sigma_m is not None and not is_measured(frame) and frame.depth_m is not None
        assert (frame.depth_sigma_m[frame.depth_m > 0] > 0).all()
    found = json.loads(run("info", with_depth, "--json").stdout)
    assert (found["frames_with_depth"], found["frames_with_computed_depth"]) == (0, len(frames))
    assert not (tmp_path / "folder" / "depth").exists() and not (tmp_path / "tum" / "depth").exists()
    assert any("computed, not a sensor's" in notice for notice in tum.notices)
    import_recording(tmp_path / "folder", tmp_path / "back.mcap")
    with LogReader(tmp_path / "back.mcap") as back:
        others = [f for f in back if f.depth_m is not None]
    for a, b in zip(frames, others, strict=True):
        assert np.array_equal(a.depth_m, b.depth_m) and np.array_equal(a.depth_sigma_m, b.depth_sigma_m)  # type: ignore[arg-type]


def test_a_log_with_computed_depth_replays_as_computed_and_off_leaves_it_out(
    with_depth: Path, weights: Path, config: Path, tmp_path: Path
) -> None:
    for source, key in (("auto", "computed_fraction"), ("off", "rendered_fraction"), ("sensor", "rendered_fraction")):
        done = run(
            "replay",
            with_depth,
            "--out",
            tmp_path / source,
            "--weights",
            weights,
            "--config",
            config,
            "--depth",
            source,
        )
        summary = json.loads((tmp_path / source / "summary.json").read_text())
        assert done.returncode == (0 if summary["map"]["surface_points"] else 3), done.stderr
        assert summary["depth"][key] == 1.0


def test_parts_stay_parts(weights: Path, tmp_path: Path) -> None:
    source, new = tmp_path / "source", tmp_path / "new"
    source.mkdir(), new.mkdir()
    info = StreamInfo("test room", {"rooms": INTRINSICS})
    with_frames = [encode_frame(f) for f in unlabelled(tiny_frames(6))]
    recording = Recording(
        source / "day.mcap", info, RecordingRules(split_bytes=2 * sum(map(len, with_frames[0]))), recording="r1"
    )
    for parts in with_frames:
        recording.write(parts)
    recording.close()
    with open_log(source) as log:
        counts = [len(LogReader(part)) for part in log.paths]
    assert len(counts) > 1
    done = run("autolabel", source, "--weights", weights, "--out", new / "day.mcap")
    assert done.returncode == 0, done.stderr
    with open_log(new) as log:
        made = [LogReader(part) for part in log.paths]
        assert [len(part) for part in made] == counts and not log.notices
        assert all(f.label_is_pseudo for f in log)
        notes = [read_note(part.attachments()) for part in made]
    assert notes[0] is not None and notes[0].frames == 6 and all(note == notes[0] for note in notes)
    done = run("autolabel", source, "--weights", weights, "--out", source / "more.mcap")
    assert done.returncode == 1 and "would be read as one" in error_line(done.stderr)


OTHER = make_label_set("kitchen", ["stove", "spoon"])


def write_labels_of(path: Path, label_set: LabelSet) -> Path:
    frames = [dataclasses.replace(f, label=np.full((72, 96), label_set.ids[0], np.uint8)) for f in tiny_frames(3)]
    with LogWriter(path, StreamInfo("t", {"rooms": INTRINSICS}, label_set)) as log:
        for frame in frames:
            log.write_frame(frame)
    return path


def test_other_classes_are_refused_unless_all_labels_go(weights: Path, tmp_path: Path) -> None:
    log, out = write_labels_of(tmp_path / "log.mcap", OTHER), tmp_path / "new.mcap"
    done = run("autolabel", log, "--weights", weights, "--out", out)
    said = error_line(done.stderr)
    assert done.returncode == 1 and not out.exists()
    assert "'kitchen' (stove, spoon)" in said and "'rooms' (wall, floor" in said and "--overwrite-labels" in said
    assert run("autolabel", log, "--weights", weights, "--out", out, "--overwrite-labels").returncode == 0
    with LogReader(out) as new:
        assert new.info.label_set == ROOMS


def test_the_same_classes_with_other_ids_become_the_logs_ids(weights: Path, tmp_path: Path) -> None:
    shifted = make_label_set("rooms+100", ROOMS.names, ids=[i + 100 for i in ROOMS.ids])
    log = write_labels_of(tmp_path / "log.mcap", shifted)
    with LogReader(log) as old, LogWriter(tmp_path / "more.mcap", old.info) as more:
        for i, frame in enumerate(old):
            more.write_frame(frame if i == 0 else dataclasses.replace(frame, label=None))
    report = relabelled(tmp_path / "more.mcap", tmp_path / "new.mcap", weights)
    assert (report.note.kept, report.note.labelled) == (1, 2)
    with LogReader(tmp_path / "new.mcap") as new:
        assert new.info.label_set == shifted
        for frame in new:
            assert frame.label is not None
            shifted.to_channels(frame.label)


def test_places_that_are_taken_are_refused(log: Path, new: Path, weights: Path, tmp_path: Path) -> None:
    before = new.read_bytes()
    for source, out, said in (
        (log, log, "exists already"),
        (log, new, "exists already"),
        (log, tmp_path, "is a folder"),
        (tmp_path / "none.mcap", tmp_path / "out.mcap", "none.mcap"),
    ):
        done = run("autolabel", source, "--weights", weights, "--out", out)
        assert done.returncode == 1 and said in error_line(done.stderr)
        assert done.stdout == ""
    assert new.read_bytes() == before


def test_what_is_damaged_is_left_out_and_named(part_labelled: Path, weights: Path, tmp_path: Path) -> None:
    data = bytearray(part_labelled.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    done = run("autolabel", tmp_path / "damaged.mcap", "--weights", weights, "--out", tmp_path / "new.mcap")
    assert done.returncode == 0, done.stderr
    assert "damaged, left out: " in done.stdout
    with LogReader(tmp_path / "new.mcap") as log:
        assert len(log) == 5 and not log.errors
        note = read_note(log.attachments())
    assert note is not None and note.frames == 5


def test_frames_that_cannot_be_rendered_stay_without_a_label(new: Path, weights: Path, tmp_path: Path) -> None:
    odd = np.eye(4)
    odd[0, 0] = 3.0
    with LogReader(new) as log, LogWriter(tmp_path / "odd.mcap", log.info) as writer:
        for i, frame in enumerate(log):
            writer.write_frame(dataclasses.replace(frame, T_world_camera=odd) if i == 4 else frame)
    report = relabelled(tmp_path / "odd.mcap", tmp_path / "out.mcap", weights)
    assert len(report.unlabelled) == 1 and "rotation" in report.unlabelled[0]
    with LogReader(tmp_path / "out.mcap") as log:
        assert [f.label is None for f in log] == [False] * 4 + [True, False]  # its old pseudo label is gone
    with LogReader(new) as log, LogWriter(tmp_path / "all.mcap", log.info) as writer:
        for frame in log:
            writer.write_frame(dataclasses.replace(frame, T_world_camera=odd))
    with pytest.raises(LogError, match="none of its 6 frames could be rendered"):
        relabelled(tmp_path / "all.mcap", tmp_path / "none.mcap", weights)
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
