"""``label --suggest``, ``label --serve`` and ``finetune --labels``."""

import json
import signal
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.label_folder import make_label_folder
from semantic_mapper.replay.log.sequence import open_log
from tests.nodes.support import Running, refused, run_ok, write_log, write_weights
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
    return json.loads(run_ok("label", *arguments, "--json").stdout)


def test_suggestions_say_what_each_frame_adds(log: Path) -> None:
    found = suggested(log, "--suggest", "3")
    assert found["log"] == str(log) and found["labelled"] == [], "all frames of this log have labels: none counts"
    assert len(found["frames"]) == 3
    first = found["frames"][0]
    assert first["stamp_ns"] == FRAMES[first["number"]].stamp_ns and 0 < first["gain"] == first["shown"] <= 1
    text = run_ok("label", log, "--suggest", "3").stdout
    assert "adds" in text and f"{100 * first['gain']:.1f} %" in text


def test_what_is_labelled_is_not_suggested_again(log: Path, tmp_path: Path) -> None:
    order = [f["number"] for f in suggested(log, "--suggest", "6")["frames"]]
    folder = label_folder(log, tmp_path / "labels", order[0])
    with_folder = suggested(log, "--suggest", "2", "--images", folder)
    assert with_folder["labelled"] == [order[0]]
    assert [f["number"] for f in with_folder["frames"]] == order[1:3]
    weights = write_weights(tmp_path / "w.safetensors", [FRAMES[order[0]].stamp_ns])
    assert suggested(log, "--suggest", "2", "--weights", weights)["frames"] == with_folder["frames"]
    some = [f if f.seq == order[0] else replace(f, label=None) for f in FRAMES]
    assert suggested(write_log(tmp_path / "some.mcap", some), "--suggest", "2")["frames"] == with_folder["frames"]
    pseudo = [replace(f, label_is_pseudo=True) for f in FRAMES]
    assert suggested(write_log(tmp_path / "pseudo.mcap", pseudo), "--suggest", "1")["labelled"] == []
    all_of_them = label_folder(log, tmp_path / "all", *range(6))
    assert suggested(log, "--suggest", "2", "--images", all_of_them)["frames"] == []
    assert "no such folder" in refused("label", log, "--suggest", "2", "--images", tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ("--suggest 0", 2, "--suggest"),
        ("--json", 2, "goes with --suggest"),
        ("--weights x", 2, "goes with --suggest or --serve"),
        ("--suggest 2 --weights none.safetensors", 1, "none.safetensors"),
        ("--serve --out OTHER --port 0", 1, "labels of another log, other.mcap"),
    ],
)
def test_wrong_use_says_what_is_wrong(log: Path, tmp_path: Path, arguments: str, code: int, says: str) -> None:
    other = write_log(tmp_path / "other.mcap", tiny_frames(6, seed=3))
    places = {"OUT": tmp_path / "labels", "OTHER": label_folder(other, tmp_path / "others")}
    assert says in refused("label", log, *(places.get(word, word) for word in arguments.split()), code=code)


def test_the_page_is_served_until_it_is_stopped_and_says_what_came_of_it(log: Path, tmp_path: Path) -> None:
    out, classes = tmp_path / "labels", tmp_path / "classes.txt"
    classes.write_text("wall\nfloor\n")
    with Running("label", log, "--serve", "--out", out, "--classes", classes, "--suggest", "2", "--port", "0") as page:
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
    plain = write_log(tmp_path / "plain.mcap", [replace(f, label=None) for f in FRAMES])
    folder = label_folder(plain, tmp_path / "labels", 1, 4, 5)

    def finetuned(log: Path, *more: str) -> tuple[str, Checkpoint]:
        out = tmp_path / "w.safetensors"
        options = ("--labels", folder, "--seconds", "0", "--steps", "2", "--weights", weights, "--out", out)
        return run_ok("finetune", log, *options, *more).stdout, load_checkpoint(out)

    said, made = finetuned(plain)
    assert "finetuned on frames 1, 4, 5 of plain.mcap" in said and made.label_set.names == ROOMS.names
    assert made.train_stamps_ns == {FRAMES[n].stamp_ns for n in (1, 4, 5)}
    labels = [anchor.label for anchor in made.anchors]
    assert all(label is not None and (label == ROOMS.ignore_id).any() for label in labels), "strokes, no masks"
    said, grown = finetuned(plain, "--strokes")
    assert "of the keyframes' pixels have grown to" in said
    assert grown.recipe["strokes"]["painted"] < grown.recipe["strokes"]["grown"] <= 1
    assert finetuned(log, "--keyframes", "2")[1].train_stamps_ns < made.train_stamps_ns
    one, out = label_folder(log, tmp_path / "one", 3), tmp_path / "none.safetensors"
    for said, words in (("finetuning needs two", ()), ("--keyframes 2 is more than that", ("--keyframes", "2"))):
        assert said in refused("finetune", log, "--out", out, "--labels", one, *words) and not out.exists()
