"""How much a finetuned field's own image should count among the views, on rays with and without measured depth.

Renders frames that the weights were not finetuned on from their keyframes and the frame's own image. Prints accuracy on
class-balanced rays and mIoU of them together.

Example: python -m research.experiments.own_view kitchen.mcap kitchen.safetensors
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint
from semantic_mapper.fields.sampling import sample_guided
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.training.finetune import HELD_OUT_SOURCES, FinetuneConfig
from semantic_mapper.training.losses import IGNORE
from semantic_mapper.training.overlap import view_overlap
from semantic_mapper.training.views import LabelledView, draw_pixels, query_rays, stack_sources, view_from_frame

FACTORS = (1.0, 4.0, 16.0, 1e3)
RAYS = 3000  # a frame
EVERY = 4  # th frame


def main() -> None:
    """Print a row a factor, and one of the own image alone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("weights", type=Path)
    given = parser.parse_args()
    checkpoint = load_checkpoint(given.weights)
    count = len(checkpoint.label_set)
    confusion = {name: np.zeros((2, count, count), np.int64) for name in ("own image", *(f"{f:g}" for f in FACTORS))}
    for truth, measured, found in _predictions(checkpoint, *_views(checkpoint, given.log)):
        for name, channel in found.items():
            np.add.at(confusion[name], (measured.astype(int), truth, channel), 1)
    print(f"{'':>20} {'measured':>9} {'without':>9} {'mIoU':>6}")
    for name, matrix in confusion.items():
        _row(name, matrix)
    _row("4, without 1000", np.stack((confusion["1000"][0], confusion["4"][1])))


def _views(checkpoint: Checkpoint, path: Path) -> tuple[list[LabelledView], list[LabelledView]]:
    """Keyframes of the weights, and frames to render."""
    with open_log(path) as log:
        frames = [frame for frame in log if frame.label is not None]
    width, stamps = FinetuneConfig().width, checkpoint.train_stamps_ns
    keyframes = [f for f in frames if f.stamp_ns in stamps]
    others = [f for f in frames if f.stamp_ns not in stamps][::EVERY]
    labels = checkpoint.label_set
    return [view_from_frame(f, labels, width) for f in keyframes], [view_from_frame(f, labels, width) for f in others]


def _predictions(
    checkpoint: Checkpoint, keyframes: Sequence[LabelledView], others: Sequence[LabelledView]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_], dict[str, NDArray[np.int64]]]]:
    """True channels (R,), whether depth is measured, and found channels by name; frame by frame."""
    model, sampling = checkpoint.model.eval(), FinetuneConfig().step.sampling
    generator = torch.Generator().manual_seed(0)
    for view in others:
        overlap = view_overlap([*keyframes, view])[-1, :-1]
        best = overlap.argsort(descending=True, stable=True)[:HELD_OUT_SOURCES].tolist()
        unlabelled = replace(view, channel=torch.full_like(view.channel, IGNORE))
        flat = draw_pixels(view.channel, RAYS, 0.5, generator, len(checkpoint.label_set))
        prior = view.depth_m.flatten()[flat]
        rays, targets = query_rays(view, flat, near_m=sampling.near_m, far_m=sampling.far_m, prior=prior)
        with torch.inference_mode():
            sources = model.encode(stack_sources([*(keyframes[i] for i in best), unlabelled], with_labels=True))
            z, found = sample_guided(rays, sampling), dict[str, NDArray[np.int64]]()
            for factor in FACTORS:
                model.weigh_own_view(factor, factor)
                found[f"{factor:g}"] = model.render_samples(rays, z, sources)[0].logits.argmax(1).numpy()
            own = model.render_samples(rays, z, sources.select(torch.tensor([-1])))[0]
            found["own image"] = own.logits.argmax(1).numpy()
        yield targets.channel.numpy(), (prior > 0).numpy(), found


def _row(name: str, matrix: NDArray[np.int64]) -> None:
    without, measured = (100 * np.trace(m) / max(m.sum(), 1) for m in matrix)
    both = matrix.sum(0)
    seen = both.sum(1) > 0
    iou = np.diag(both)[seen] / (both.sum(0) + both.sum(1) - np.diag(both))[seen]
    print(f"{name:>20} {measured:>7.1f} % {without:>7.1f} % {100 * iou.mean():>6.1f}")


if __name__ == "__main__":
    main()
