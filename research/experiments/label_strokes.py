"""What strokes teach beside full masks: mIoU after the same finetuning on the same frames.

Strokes are made from the true labels as a person would paint them: of each class in a frame, ``k`` lines inside of it,
as wide as the labelling page's brush or as the class is there, and at most a sixth of the image long. Everything else
is unlabelled. Frames are those that ``label --suggest`` names.

``--grow`` lets strokes grow over what looks like them. ``--corrections N`` adds N strokes to a frame, one after the
other, each on the largest region that the strokes so far have not grown to rightly, as who looks at the page would.
``--kind irt`` fits an Implicit Ray-Transformer instead: geometry and colours of all frames, labels of the chosen ones.

Example: python -m research.experiments.label_strokes kitchen.mcap 0 1 --labels 4 --out runs/strokes.jsonl
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from research.experiments.label_suggestions import WIDTH, Choices, Scene, fit, log_scene, room_scene, score
from semantic_mapper.fields.checkpoint import adapt_model, default_checkpoint_path, load_checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.finetune import FinetuneConfig
from semantic_mapper.training.irt import fit_irt
from semantic_mapper.training.strokes import grow_strokes
from semantic_mapper.types import PosedFrame, UInt8

BRUSH = 1 / 40  # of the image's width, across: the page's own
LENGTH = 1 / 6  # of a stroke, at most
LEAST_PX = 1.5  # from a stroke's middle to what is not of the class


def paint_strokes(truth: UInt8, label_set: LabelSet, count: int, rng: np.random.Generator) -> tuple[UInt8, int]:
    """A label image with strokes alone, and how many there are.

    Args:
        truth: (H, W) class ids.
        label_set: Its classes.
        count: Strokes a class.
        rng: Draws places and directions.
    """
    painted = np.full_like(truth, label_set.ignore_id)
    width, drawn = truth.shape[1], 0
    for class_id in label_set.ids:
        inside = cv2.distanceTransform(np.pad((truth == class_id).astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
        v, u = np.nonzero(inside >= LEAST_PX)
        for _ in range(count if len(v) else 0):
            first = int(rng.integers(len(v)))
            _stroke(painted, inside, (float(u[first]), float(v[first])), class_id, width, rng)
            drawn += 1
    return painted, drawn


def _stroke(
    painted: UInt8,
    inside: np.ndarray,
    place: tuple[float, float],
    class_id: int,
    width: int,
    rng: np.random.Generator,
) -> None:
    """A line in the best of some directions, until it comes to the edge of the class."""
    best: list[tuple[float, float]] = []
    for angle in rng.uniform(0, 2 * np.pi, 8):
        line = [place]
        for step in range(1, round(LENGTH * width)):
            x, y = place[0] + step * np.cos(angle), place[1] + step * np.sin(angle)
            if not (0 <= round(y) < inside.shape[0] and 0 <= round(x) < inside.shape[1]):
                break
            if inside[round(y), round(x)] < LEAST_PX:
                break
            line.append((x, y))
        best = max(best, line, key=len)
    rows, columns = np.mgrid[: painted.shape[0], : painted.shape[1]]
    for x, y in best:
        radius = min(BRUSH * width / 2, inside[round(y), round(x)] - 0.5)
        painted[(columns - x) ** 2 + (rows - y) ** 2 <= radius**2] = class_id


def with_strokes(scene: Scene, count: int, chosen: list[int], seed: int) -> tuple[Scene, int, float]:
    """The scene with strokes in place of the chosen frames' labels, their number, and the fraction that they paint."""
    rng = np.random.default_rng(seed)
    pool, strokes, painted, labelled = list(scene.pool), 0, 0, 0
    for i in chosen:
        truth = pool[i].label
        assert truth is not None
        label, drawn = paint_strokes(truth, scene.label_set, count, rng)
        pool[i] = replace(pool[i], label=label)
        strokes += drawn
        painted += int((label != scene.label_set.ignore_id).sum())
        labelled += label.size
    return replace(scene, pool=pool), strokes, painted / labelled


def with_grown(scene: Scene, painted: Scene, chosen: list[int]) -> tuple[Scene, float, float]:
    """Strokes that have grown, the fraction of pixels that they label, and the fraction of these that are right."""
    pool, unknown = list(painted.pool), scene.label_set.ignore_id
    for i in chosen:
        pool[i] = grow_strokes(pool[i], scene.label_set)
    truth = np.stack([_label(scene.pool[i]) for i in chosen])
    label = np.stack([_label(pool[i]) for i in chosen])
    there = (label != unknown) & (truth != unknown)
    return replace(painted, pool=pool), float(there.mean()), float((label == truth)[there].mean())


def _label(frame: PosedFrame) -> UInt8:
    assert frame.label is not None
    return frame.label


def corrected(scene: Scene, painted: Scene, count: int, chosen: list[int]) -> Scene:
    """Strokes and ``count`` more a frame, each in the middle of the largest region that is wrong or unlabelled."""
    rng, pool = np.random.default_rng(1), list(painted.pool)
    for i in chosen:
        frame, strokes, truth = pool[i], _label(pool[i]).copy(), _label(scene.pool[i])
        for _ in range(count):
            grown = _label(grow_strokes(replace(frame, label=strokes), scene.label_set))
            found = _largest_wrong(grown, truth, scene.label_set)
            if found is None:
                break
            class_id, inside = found
            v, u = np.unravel_index(int(inside.argmax()), inside.shape)
            _stroke(strokes, inside, (float(u), float(v)), class_id, truth.shape[1], rng)
        pool[i] = replace(frame, label=strokes)
    return replace(painted, pool=pool)


def _largest_wrong(grown: UInt8, truth: UInt8, label_set: LabelSet) -> tuple[int, np.ndarray] | None:
    """Class of the largest connected region without its label, and distances (H, W) to its border; None = too thin."""
    wrong = (grown != truth) & (truth != label_set.ignore_id)
    best, largest = None, 0
    for class_id in label_set.ids:
        _, part, stats, _ = cv2.connectedComponentsWithStats((wrong & (truth == class_id)).astype(np.uint8))
        for number, area in enumerate(stats[1:, cv2.CC_STAT_AREA], 1):
            if area > largest:
                best, largest = (class_id, part == number), area
    if best is None:
        return None
    inside = cv2.distanceTransform(np.pad(best[1].astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    return (best[0], inside) if inside.max() >= LEAST_PX else None


def fit_scene_irt(scene: Scene, chosen: list[int], steps: int) -> LearnedField:
    """An IRT of the scene: all of its frames, labels of the chosen ones alone."""
    labelled = [scene.pool[i] for i in chosen]
    others = [frame for i, frame in enumerate(scene.pool) if i not in chosen] + scene.scored
    frames = labelled + [replace(frame, label=None) for frame in others]
    config = FinetuneConfig(seconds=0, steps=steps, width=WIDTH)
    return fit_irt(frames, scene.label_set, None, config).model


def _as_shipped(scene: Scene) -> LearnedField:
    return adapt_model(load_checkpoint(default_checkpoint_path()).model, scene.label_set)


def main() -> None:
    """Print a row a scene and kind of label."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="logs with labels; a number = that validation room")
    parser.add_argument("--steps", type=int, default=40, help="of finetuning; 0 = class rows alone")
    parser.add_argument("--labels", type=int, default=4, help="number of labelled frames")
    parser.add_argument("--kind", choices=("sray", "irt"), default="sray")
    parser.add_argument("--strokes", default="0,1,2", help="a class and frame; 0 = full masks, -1 = learn nothing")
    parser.add_argument("--grow", action="store_true", help="strokes grow, as `finetune --strokes` lets them")
    parser.add_argument("--corrections", type=int, default=0, help="further strokes a frame")
    parser.add_argument("--out", type=Path, required=True, help="figures as JSON, a line each")
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for name in given.scenes:
        scene = room_scene(int(name)) if name.isdigit() else log_scene(Path(name))
        choices = Choices(scene)
        chosen = choices.choose("suggested", given.labels, 0)
        for count in map(int, given.strokes.split(",")):
            painted, strokes, fraction = scene, 0, float(count == 0)
            if count > 0:
                painted, strokes, fraction = with_strokes(scene, count, chosen, 0)
            right = 1.0
            if count > 0 and given.corrections:
                painted = corrected(scene, painted, given.corrections, chosen)
                strokes += given.corrections * len(chosen)
            if count > 0 and given.grow:
                painted, fraction, right = with_grown(scene, painted, chosen)
            began = time.process_time()
            if count < 0:
                model = _as_shipped(scene)
            elif given.kind == "irt":
                model = fit_scene_irt(painted, chosen, given.steps)
            else:
                model = fit(painted, chosen, given.steps, 0)
            cpu_s = time.process_time() - began
            miou = score(scene, chosen, model, choices.candidates)
            row = {
                "scene": scene.name,
                "kind": given.kind,
                "strokes_a_class": count,
                "strokes": strokes,
                "corrections": given.corrections,
                "grown": given.grow,
                "labelled": round(fraction, 4),
                "right": round(right, 4),
            }
            with given.out.open("a") as file:
                file.write(
                    json.dumps({**row, "steps": given.steps, "miou": round(miou, 4), "cpu_s": round(cpu_s)}) + "\n"
                )
            print(
                f"{scene.name:>10} {count} strokes a class ({strokes} in all, {100 * fraction:.1f} % labelled, "
                f"{100 * right:.1f} % of it right): "
                f"{100 * miou:.1f} %, {cpu_s:.0f} CPU s",
                flush=True,
            )


if __name__ == "__main__":
    main()
