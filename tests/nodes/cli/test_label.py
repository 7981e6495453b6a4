"""``label --suggest``, ``label --serve`` and ``finetune --labels``."""

from __future__ import annotations

import dataclasses
import json
import signal
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.label_folder import make_label_folder
from semantic_mapper.replay.log.sequence import open_log
from tests.nodes.support import COMMAND, Running, error_line, run, run_here, write_log, write_weights
from tests.small import tiny_frames

FRAMES = tiny_frames(6)


def painted(number: int) -> np.ndarray:
    """Two strokes of what is there."""
    truth = FRAMES[number].label
    assert truth is not None
    label = np.full_like(truth, ROOMS.ignore_id)
    label[20:26, 8:88], label[50:56, 8:88] = truth[20:26, 8:88], truth[50:56, 8:88]
    return label


def label_folder(log: Path, out: Path, *numbers: int) -> Path:
    with open_log(log) as opened:
        folder = make_label_folder(out, opened, ROOMS)
        for number in numbers:
            folder.write(number, painted(number))
    return out


def suggested(*arguments: str | Path) -> dict:
    done = run("label", *arguments, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_suggestions_say_what_each_frame_adds(log: Path) -> None:
    found = suggested(log, "--suggest", "3")
    assert found["log"] == str(log) and found["labelled"] == [], "all frames of this log have labels: none counts"
    assert len(found["frames"]) == 3
    first = found["frames"][0]
    assert first["stamp_ns"] == FRAMES[first["number"]].stamp_ns and 0 < first["gain"] == first["shown"] <= 1
    code, text = run_here("label", log, "--suggest", "3")
    assert code == 0 and "adds" in text and f"{100 * first['gain']:.1f} %" in text


def test_what_is_labelled_is_not_suggested_again(log: Path, tmp_path: Path) -> None:
    order = [f["number"] for f in suggested(log, "--suggest", "6")["frames"]]
    folder = label_folder(log, tmp_path / "labels", order[0])
    with_folder = suggested(log, "--suggest", "2", "--images", folder)
    assert with_folder["labelled"] == [order[0]]
    assert [f["number"] for f in with_folder["frames"]] == order[1:3]
    weights = write_weights(tmp_path / "w.safetensors", [FRAMES[order[0]].stamp_ns])
    assert suggested(log, "--suggest", "2", "--weights", weights)["frames"] == with_folder["frames"]
    some = [f if f.seq == order[0] else dataclasses.replace(f, label=None) for f in FRAMES]
    assert suggested(write_log(tmp_path / "some.mcap", some), "--suggest", "2")["frames"] == with_folder["frames"]
    pseudo = [dataclasses.replace(f, label_is_pseudo=True) for f in FRAMES]
    assert suggested(write_log(tmp_path / "pseudo.mcap", pseudo), "--suggest", "1")["labelled"] == []
    all_of_them = label_folder(log, tmp_path / "all", *range(6))
    assert suggested(log, "--suggest", "2", "--images", all_of_them)["frames"] == []
    assert "show all that it shows" in run("label", log, "--suggest", "2", "--images", all_of_them).stdout
    done = run("label", log, "--suggest", "2", "--images", tmp_path / "nowhere")
    assert done.returncode == 1 and "no such folder" in error_line(done.stderr)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--suggest", "0"), 2, "--suggest"),
        (("--json",), 2, "goes with --suggest"),
        (("--serve", "--json"), 2, "goes with --suggest"),
        (("--classes", "x.txt"), 2, "go with --serve"),
        (("--suggest", "2", "--out", "x"), 2, "go with --serve"),
        (("--weights", "x"), 2, "goes with --suggest or --serve"),
        (("--serve", "--images", "x"), 2, "goes on with what is in --out"),
        (("--suggest", "2", "--to", "x"), 2, "nothing is sent"),
        (("--serve", "--classes", "none.txt"), 1, "none.txt"),
        (("--suggest", "2", "--weights", "none.safetensors"), 1, "none.safetensors"),
    ],
)
def test_wrong_use_says_what_is_wrong(
    log: Path, tmp_path: Path, arguments: tuple[str, ...], code: int, says: str
) -> None:
    out = ("--out", tmp_path / "labels") if "--serve" in arguments else ()
    done = run("label", log, *arguments, *out)
    assert done.returncode == code and says in done.stderr


def test_the_page_of_another_logs_folder_is_refused(log: Path, tmp_path: Path) -> None:
    other = write_log(tmp_path / "other.mcap", tiny_frames(6, seed=3))
    folder = label_folder(other, tmp_path / "labels")
    done = run("label", log, "--serve", "--out", folder, "--port", "0")
    assert done.returncode == 1 and "labels of another log, other.mcap" in error_line(done.stderr)


def test_the_page_is_served_until_it_is_stopped_and_says_what_came_of_it(log: Path, tmp_path: Path) -> None:
    out, classes = tmp_path / "labels", tmp_path / "classes.txt"
    classes.write_text("wall\nfloor\n")
    assert COMMAND.exists()
    with Running("label", log, "--serve", "--out", out, "--classes", classes, "--suggest", "2", "--port", "0") as page:
        assert page.process.stdout is not None
        url = page.process.stdout.readline().removeprefix("label at ").strip()
        with urllib.request.urlopen(f"{url}session", timeout=60) as answer:
            session = json.load(answer)
        assert [c["name"] for c in session["classes"]] == ["wall", "floor"] and len(session["order"]) == 2
        body = bytes([1]) * (96 * 72)
        request = urllib.request.Request(f"{url}frames/{session['order'][0]}/label", data=body, method="PUT")
        with urllib.request.urlopen(request, timeout=60) as answer:
            assert answer.status == 200
        page.process.send_signal(signal.SIGINT)
        rest = page.process.stdout.read()
        assert page.wait() == 0, page.text
    assert "finetune" in rest and "1 labelled frame of room.mcap" in rest
    written = cv2.imread(str(out / f"{session['order'][0]:06d}.png"), cv2.IMREAD_UNCHANGED)
    assert (written == 1).all()


def test_finetuning_learns_from_strokes_of_a_folder(log: Path, weights: Path, tmp_path: Path) -> None:
    plain = write_log(tmp_path / "plain.mcap", [dataclasses.replace(f, label=None) for f in FRAMES])
    folder = label_folder(plain, tmp_path / "labels", 1, 4, 5)
    options = ("--labels", folder, "--seconds", "0", "--steps", "2", "--weights", weights)
    done = run("finetune", plain, *options, "--out", tmp_path / "w.safetensors")
    assert done.returncode == 0, done.stderr
    assert "finetuned on frames 1, 4, 5 of plain.mcap" in done.stdout
    made = load_checkpoint(tmp_path / "w.safetensors")
    assert made.label_set.names == ROOMS.names
    assert made.train_stamps_ns == {FRAMES[n].stamp_ns for n in (1, 4, 5)}
    labels = [anchor.label for anchor in made.anchors]
    assert all(label is not None and (label == ROOMS.ignore_id).any() for label in labels), "strokes, no masks"
    done = run("finetune", plain, *options, "--strokes", "--out", tmp_path / "grown.safetensors")
    assert done.returncode == 0 and "of the keyframes' pixels have grown to" in done.stdout, done.stderr
    grown = load_checkpoint(tmp_path / "grown.safetensors")
    painted, after = grown.recipe["strokes"]["painted"], grown.recipe["strokes"]["grown"]
    assert painted < after <= 1
    done = run("finetune", log, *options, "--keyframes", "2", "--out", tmp_path / "two.safetensors")
    assert done.returncode == 0, done.stderr
    assert load_checkpoint(tmp_path / "two.safetensors").train_stamps_ns < made.train_stamps_ns


def test_label_folders_that_cannot_be_learned_from_are_refused(log: Path, weights: Path, tmp_path: Path) -> None:
    out = ("--weights", weights, "--out", tmp_path / "w.safetensors")
    one = label_folder(log, tmp_path / "one", 3)
    done = run("finetune", log, "--labels", one, *out)
    assert done.returncode == 1 and "1 of the 6 frames have usable labels; finetuning needs two" in done.stderr
    done = run("finetune", log, "--labels", one, "--keyframes", "2", *out)
    assert done.returncode == 1 and "--keyframes 2 is more than that" in done.stderr
    other = label_folder(write_log(tmp_path / "other.mcap", tiny_frames(6, seed=3)), tmp_path / "other", 1, 2)
    done = run("finetune", log, "--labels", other, *out)
    assert done.returncode == 1 and "labels of another log" in error_line(done.stderr)
    done = run("finetune", log, "--labels", tmp_path / "none", *out)
    assert done.returncode == 1 and "has no label images" in error_line(done.stderr)
    done = run("finetune", log, "--kind", "grid", "--labels", one, "--out", tmp_path / "w.safetensors")
    assert done.returncode == 2 and "learns from no keyframes" in done.stderr
    assert not (tmp_path / "w.safetensors").exists()
