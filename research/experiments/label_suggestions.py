"""How many labelled frames it takes: mIoU against their number, by who chooses them.

Half of a scene's frames may be labelled, the others are scored: rendered from the labelled frames and their own image.
Every choice gets the same finetuning of the shipped weights, or (``--steps 0``) their class rows alone are fitted.

Choices: ``random``; ``spread`` evenly over time; ``coverage``, by which ``finetune --keyframes`` chooses; ``suggested``
by ``label --suggest``; ``entropy`` and ``disagreement``, the same with each pixel weighted by the entropy of what the
shipped weights say of it (rendered from other frames, and by its own image), or by how much these two differ.

Example: python -m research.experiments.label_suggestions kitchen.mcap rooms --steps 40 --out runs/suggestions.jsonl
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from research.scenes import VALIDATION_SEEDS, room_frames
from semantic_mapper.config import MapperConfig
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields.base import EncodedViews, ImageClassifier, SemanticField, stack_views
from semantic_mapper.fields.checkpoint import adapt_model, default_checkpoint_path, load_checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.render import render_view
from semantic_mapper.imaging import resize_depth, resize_label, working_intrinsics
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.mapper import make_field
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.training.finetune import FinetuneConfig, finetune
from semantic_mapper.training.linear_probe import fit_class_rows
from semantic_mapper.training.select import CANDIDATE_WIDTH, Candidate, candidate_from_frame, choose_keyframes
from semantic_mapper.training.suggest import suggest_frames
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

WIDTH = 160  # of the images that are learned from
CAMERA = CameraIntrinsics(99.2, 99.2, 79.5, 59.5, WIDTH, 120)
POOL, SCORED = 50, 24  # frames of a scene that may be labelled, and that are scored
SOURCES = 7  # labelled frames that a scored one is rendered from, and others that a candidate is
PROBE_STEPS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Frames that may be labelled, and frames to score."""

    name: str
    label_set: LabelSet
    pool: list[PosedFrame]
    scored: list[PosedFrame]


def log_scene(path: Path) -> Scene:
    """Frames of a log, every second one to score."""
    with open_log(path) as log:
        assert log.info.label_set is not None, "needs labels"
        count = min(len(log), 2 * POOL)
        frames = [log.frame(int(i)) for i in np.linspace(0, len(log) - 1, count).round()]
        return _scene(path.stem, log.info.label_set, frames)


def room_scene(number: int) -> Scene:
    """A validation room."""
    frames = list(room_frames(VALIDATION_SEEDS[number], 2 * POOL, CAMERA))
    return _scene(f"room {number}", ROOMS, frames)


def _scene(name: str, label_set: LabelSet, frames: list[PosedFrame]) -> Scene:
    odd = frames[1::2]
    return Scene(name, label_set, frames[::2], odd[:: max(1, len(odd) // SCORED)][:SCORED])


class Choices:
    """Who chooses the frames to label; candidates are the pool's frames."""

    def __init__(self, scene: Scene) -> None:
        self.candidates = [candidate_from_frame(frame) for frame in scene.pool]
        self._scene = scene
        self._doubts: dict[str, list[Float64]] = {}

    def choose(self, who: str, count: int, seed: int) -> list[int]:
        """Numbers of the frames to label."""
        last = len(self.candidates) - 1
        if who == "random":
            return sorted(np.random.default_rng(seed).choice(last + 1, count, replace=False).tolist())
        if who == "spread":
            return [int(i) for i in np.linspace(0, last, count + 2)[1:-1].round()]
        if who == "coverage":
            return choose_keyframes(self.candidates, count, seed)
        weights = None if who == "suggested" else self._doubt(who)
        return sorted(s.index for s in suggest_frames(self.candidates, count, (), weights))

    def _doubt(self, what: str) -> list[Float64]:
        if not self._doubts:
            self._doubts = doubts(self._scene, self.candidates)
        return self._doubts[what]


def doubts(scene: Scene, candidates: Sequence[Candidate]) -> dict[str, list[Float64]]:
    """What the shipped weights do not know of each candidate's pixels, by how it is found: arrays (P,) in [0, 1]."""
    config = MapperConfig()
    model = load_checkpoint(default_checkpoint_path()).model
    field = make_field(model, config)
    assert isinstance(field, ImageClassifier)
    encoded = encode(field, scene.pool, scene.label_set)
    intrinsics = working_intrinsics(scene.pool[0].intrinsics, CANDIDATE_WIDTH)
    size, levels = (intrinsics.height, intrinsics.width), float(np.log(len(field.label_set)))
    found: dict[str, list[Float64]] = {"entropy": [], "disagreement": []}
    for number, frame in enumerate(scene.pool):
        depth_m = resize_depth(frame, intrinsics)
        near = _sharing(candidates, number)
        pose = frame.T_world_camera
        sources = stack_views([encoded[i] for i in near])
        rendered, known, _ = render_view(field, sources, intrinsics, pose, depth_m, config.sampling, 0)
        logits = field.source_logits(encoded[number])
        assert logits is not None
        large = functional.interpolate(logits, size=size, mode="bilinear", align_corners=False)
        own = torch.softmax(large, 1)[0].permute(1, 2, 0).numpy()
        entropy = 0.5 * (np.where(known, _entropy(rendered), levels) + _entropy(own)) / levels
        differ = np.where(known, 0.5 * np.abs(rendered - own).sum(-1), 1.0)
        found["entropy"].append(entropy[depth_m > 0].astype(np.float64))
        found["disagreement"].append(differ[depth_m > 0].astype(np.float64))
    return found


def _entropy(p: np.ndarray) -> np.ndarray:
    return -(p * np.log(np.maximum(p, 1e-9))).sum(-1)


def _sharing(candidates: Sequence[Candidate], number: int) -> list[int]:
    """The other candidates that share most cells with one."""
    here = _cell_keys(candidates[number])
    shared = [len(np.intersect1d(here, _cell_keys(c))) if i != number else -1 for i, c in enumerate(candidates)]
    return [int(i) for i in np.argsort(shared)[::-1][:SOURCES]]


def _cell_keys(candidate: Candidate) -> np.ndarray:
    return np.unique(((candidate.cells + (1 << 15)) * [1, 1 << 17, 1 << 34]).sum(1))


def encode(field: SemanticField, frames: Sequence[PosedFrame], label_set: LabelSet) -> list[EncodedViews]:
    """Each frame by itself, without its labels."""
    views = [view_from_frame(replace(frame, label=None), label_set, WIDTH) for frame in frames]
    with torch.inference_mode():
        return [field.encode(stack_sources([view])) for view in views]


def fit(scene: Scene, chosen: Sequence[int], steps: int, seed: int) -> LearnedField:
    """The shipped weights after learning from the chosen frames."""
    start = load_checkpoint(default_checkpoint_path()).model
    frames = [scene.pool[i] for i in chosen]
    if steps:
        config = FinetuneConfig(
            seconds=0, steps=steps, width=WIDTH, evaluations=1, patience=0, image_fraction=1.0, seed=seed
        )
        return finetune(frames, scene.label_set, start, config).model
    torch.manual_seed(seed)
    model = adapt_model(start, scene.label_set).eval()
    views = [view_from_frame(frame, scene.label_set, WIDTH) for frame in frames]
    with torch.no_grad():
        encoded = model.encode(stack_sources(views))
    fit_class_rows(model, encoded, views, PROBE_STEPS)
    return model


def score(scene: Scene, chosen: Sequence[int], model: LearnedField, candidates: Sequence[Candidate]) -> float:
    """mIoU of the scored frames, rendered from those labelled frames that show most of them, and their own images."""
    config = MapperConfig()
    field = make_field(model.eval(), config)
    labelled = encode(field, [scene.pool[i] for i in chosen], scene.label_set)
    keys = [_cell_keys(candidates[i]) for i in chosen]
    confusion = ConfusionMatrix(scene.label_set)
    for frame, own in zip(scene.scored, encode(field, scene.scored, scene.label_set), strict=True):
        here = _cell_keys(candidate_from_frame(frame))
        best = np.argsort([-len(np.intersect1d(here, k)) for k in keys], kind="stable")[:SOURCES]
        intrinsics = working_intrinsics(frame.intrinsics, CANDIDATE_WIDTH)
        sources = stack_views([*(labelled[int(i)] for i in best), own])
        depth_m = resize_depth(frame, intrinsics)
        found, known, _ = render_view(field, sources, intrinsics, frame.T_world_camera, depth_m, config.sampling, 0)
        assert frame.label is not None
        label = np.where(known, scene.label_set.to_ids(found.argmax(-1)), np.uint8(scene.label_set.ignore_id))
        confusion.update(resize_label(frame.label, intrinsics), label.astype(np.uint8))
    miou = confusion.metrics().miou
    assert miou is not None
    return miou


def main() -> None:
    """Print a row a scene and choice, and write every figure as it comes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="logs with labels; a number = that validation room; rooms = 0 to 2")
    parser.add_argument("--steps", type=int, default=40, help="of finetuning; 0 = class rows alone")
    parser.add_argument("--labels", default="2,3,4,6", help="numbers of labelled frames")
    parser.add_argument("--choices", default="spread,suggested,random,entropy")
    parser.add_argument("--seeds", type=int, default=1, help="of random choices")
    parser.add_argument("--out", type=Path, required=True, help="figures as JSON, a line each; known ones are kept")
    given = parser.parse_args()
    torch.set_num_threads(1)
    counts = [int(n) for n in given.labels.split(",")]
    names = [n for name in given.scenes for n in (("0", "1", "2") if name == "rooms" else (name,))]
    makers: list[Callable[[], Scene]] = [
        (lambda n=name: room_scene(int(n))) if name.isdigit() else (lambda n=name: log_scene(Path(n))) for name in names
    ]
    given.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    known = {(r["scene"], r["choice"], r["labels"], r["seed"], r["steps"]): r["miou"] for r in rows}
    for make in makers:
        scene = make()
        choices = Choices(scene)
        fitted: dict[tuple[int, ...], float] = {}
        for who in given.choices.split(","):
            for count in counts:
                for seed in range(given.seeds if who == "random" else 1):
                    key = (scene.name, who, count, seed, given.steps)
                    if key in known:
                        continue
                    chosen = tuple(choices.choose(who, count, seed))
                    if chosen not in fitted:
                        model = fit(scene, chosen, given.steps, 0)
                        fitted[chosen] = score(scene, chosen, model, choices.candidates)
                    known[key] = fitted[chosen]
                    row = dict(zip(("scene", "choice", "labels", "seed", "steps"), key, strict=True))
                    with given.out.open("a") as file:
                        file.write(json.dumps({**row, "frames": chosen, "miou": round(fitted[chosen], 4)}) + "\n")
    _print(known, counts, given.steps)


def _print(known: dict[tuple[str, str, int, int, int], float], counts: Sequence[int], steps: int) -> None:
    """Tables of mIoU in %: a row a choice, a column a number of labels; each scene, then their mean."""
    here = {key: miou for key, miou in known.items() if key[4] == steps}
    scenes, choices = (list(dict.fromkeys(key[i] for key in here)) for i in (0, 1))
    for title, chosen in [*((s, [s]) for s in scenes), ("mean", scenes)]:
        print(f"{title:>14} " + " ".join(f"{n:>6}" for n in counts))
        for who in choices:
            cells = []
            for n in counts:
                means = [
                    np.mean([m for k, m in here.items() if k[:3] == (s, who, n)])
                    for s in chosen
                    if any(k[:3] == (s, who, n) for k in here)
                ]
                cells.append(f"{100 * np.mean(means):6.1f}" if len(means) == len(chosen) else "     -")
            print(f"{who:>14} " + " ".join(cells))


if __name__ == "__main__":
    main()
