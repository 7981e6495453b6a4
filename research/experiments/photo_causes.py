"""What separates photographs from rooms: one thing at a time, put into pictures of rooms or taken out of photographs.

python -m research.experiments.photo_causes DIR [val kitchen flat] [--weights FILE] [--rooms N] [--only patches holes]

DIR is that of ``kept_votes val kitchen=LOG flat=LOG``. Scored is what the own image says: mIoU and total accuracy, and
the change of mIoU with an interval over rooms, or over the pictures of a recording.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from research.evaluation.bootstrap import paired_bootstrap
from research.experiments.kept_votes import frames_of
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.evaluate.methods import Predictor, field_predictors
from semantic_mapper.types import PosedFrame

ROOMS, PHOTOGRAPHS = "val", "kitchen"  # sources that things are taken from for the others
OF_ROOM, OF_RECORDING = 5, 32  # frames, about, where there are so many
Array = NDArray[Any]
Frames = Sequence[PosedFrame]


class Picture(NamedTuple):
    """Colours (H, W, 3) of 0 to 255, depth (H, W) in metres, and labels (H, W) of a frame."""

    rgb: Array
    depth: Array
    label: Array


class Other(NamedTuple):
    """A picture of the other kind (of a recording for rooms, of a room for recordings) at the same size."""

    rgb: Array
    depth: Array
    gains: Array  # (3,) mean colours of its kind to their mean
    light: Array  # mean and deviation of all values of its kind
    ignore_id: int
    rng: np.random.Generator


def _patches(p: Picture, o: Other) -> Picture:
    (rgb, depth, label), (height, width) = map(np.copy, p), p.depth.shape
    for side in (width * o.rng.uniform(0.05, 0.12, 12)).astype(int):
        (y, v), (x, u) = o.rng.integers(height - side, size=2), o.rng.integers(width - side, size=2)
        at = np.s_[y : y + side, x : x + side]
        rgb[at], depth[at], label[at] = o.rgb[v : v + side, u : u + side], 0.93 * depth[at], o.ignore_id
    return Picture(rgb, depth, label)


def _gains(rgb: Array) -> Array:
    return rgb.mean((0, 1)) / rgb.mean()


def _smooth(rgb: Array) -> Array:
    return cv2.bilateralFilter(cv2.bilateralFilter(rgb, 9, 50, rgb.shape[1] / 64), 9, 50, rgb.shape[1] / 64)


def _blur(rgb: Array, sigma: float) -> Array:
    return cv2.GaussianBlur(rgb, (0, 0), sigma * rgb.shape[1] / 320)


def _lens(p: Picture, _: Other) -> Picture:
    y, x = (np.linspace(-1, 1, n)[:, None] for n in p.depth.shape)
    return p._replace(rgb=_blur(p.rgb, 1) * (1 - 0.2 * (x[None] ** 2 + y[:, None] ** 2)))


def _resize(image: Array, size: tuple[int, ...], how: int = cv2.INTER_AREA) -> Array:
    return cv2.resize(image, size, interpolation=how)


def _jpeg(rgb: Array) -> Array:
    data = cv2.imencode(".jpg", rgb[..., ::-1].astype(np.uint8), (cv2.IMWRITE_JPEG_QUALITY, 25))[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1]


def _kinect(z: Array, rng: np.random.Generator) -> Array:
    step = np.maximum(0.0028 * z**2, 1e-6)
    return np.round((z + rng.normal(0, 0.0025, z.shape) * z**2) / step) * step


def _filled(z: Array) -> Array:
    nearest = distance_transform_edt(z == 0, return_distances=False, return_indices=True)
    return z[tuple(np.asarray(nearest))] if z.any() else z


Change = Callable[[Picture, Other], Picture]
IN_BOTH: dict[str, Change] = {
    "smooth, by a bilateral filter": lambda p, _: p._replace(rgb=_smooth(p.rgb)),
    "white balance of the others": lambda p, o: p._replace(rgb=p.rgb * o.gains / _gains(p.rgb)),
    "light of the others": lambda p, o: p._replace(rgb=(p.rgb - p.rgb.mean()) / p.rgb.std() * o.light[1] + o.light[0]),
    "grey": lambda p, _: p._replace(rgb=p.rgb.mean(2, keepdims=True).repeat(3, 2)),
    "no depth": lambda p, _: p._replace(depth=0 * p.depth),
    "depth alone": lambda p, _: p._replace(rgb=np.full_like(p.rgb, 128)),
}
OF_ROOMS: dict[str, Change] = {
    "12 patches of the others (5 to 12 % of the width; not scored, 7 % nearer)": _patches,
    "holes of the others' depth": lambda p, o: p._replace(depth=p.depth * (o.depth > 0)),
    "no depth beyond 3.5 m": lambda p, _: p._replace(depth=p.depth * (p.depth < 3.5)),
    "depth noise of 2.5 mm at 1 m, with the square, and steps": lambda p, o: p._replace(depth=_kinect(p.depth, o.rng)),
    "details of the others on smooth pictures": lambda p, o: p._replace(rgb=_smooth(p.rgb) + o.rgb - _smooth(o.rgb)),
    "low resolution: 107x80 and back": lambda p, _: p._replace(
        rgb=_resize(_resize(p.rgb, (107, 80)), p.depth.shape[::-1], cv2.INTER_LINEAR)
    ),
    "JPEG, quality 25": lambda p, _: p._replace(rgb=_jpeg(p.rgb)),
    "lens: sigma 1 px of 320, 40 % vignette": _lens,
    "noise, sigma 4": lambda p, o: p._replace(rgb=p.rgb + o.rng.normal(0, 4, p.rgb.shape)),
}
OF_RECORDINGS: dict[str, Change] = {
    "denoised, by non-local means": lambda p, _: p._replace(
        rgb=cv2.fastNlMeansDenoisingColored(p.rgb.astype(np.uint8), None, 4, 4, 5, 11)
    ),
    "sharpened: unsharp mask, sigma 1.5 px of 320": lambda p, _: p._replace(rgb=2 * p.rgb - _blur(p.rgb, 1.5)),
    "white balance by the grey world": lambda p, _: p._replace(rgb=p.rgb / _gains(p.rgb)),
    "holes filled by the nearest depth": lambda p, _: p._replace(depth=_filled(p.depth)),
}


def score(
    groups: Sequence[Frames], change: Change, others: Frames, ask: Predictor, labels: LabelSet
) -> list[ConfusionMatrix]:
    """Of each group of frames, with a change; draws are the same for all changes."""
    rng, found = np.random.default_rng(0), list[ConfusionMatrix]()
    gains = np.mean([_gains(f.rgb) for f in others], 0)
    light = np.mean([(f.rgb.mean(), f.rgb.std()) for f in others], 0)
    for frames in groups:
        found.append(ConfusionMatrix(labels))
        for f in frames:
            other, size = others[int(rng.integers(len(others)))], f.rgb.shape[1::-1]
            colours, depth = _resize(other.rgb.astype(np.float32), size), np.asarray(other.depth_m)
            o = Other(colours, _resize(depth, size, cv2.INTER_NEAREST), gains, light, labels.ignore_id, rng)
            p = change(Picture(f.rgb.astype(np.float32), np.asarray(f.depth_m), np.asarray(f.label)), o)
            rgb = np.ascontiguousarray(np.rint(p.rgb).clip(0, 255), np.uint8)
            said = ask(replace(f, rgb=rgb, depth_m=np.ascontiguousarray(p.depth, np.float32))).label
            found[-1].update(p.label, said, "frame")
    return found


def main() -> None:
    """Print a table a source."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sources", nargs="*", default=[ROOMS, PHOTOGRAPHS, "flat"])
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--only", nargs="+", default=[""], help="words of the changes to make")
    given = parser.parse_args()
    mapper = Mapper.load(given.weights)
    labels, ask = mapper.label_set, field_predictors(mapper)["own image alone"]

    def groups(source: str) -> list[list[PosedFrame]]:
        if source != ROOMS:
            frames = frames_of(given.folder / f"{source}.npz", labels)
            return [[f] for f in frames[:: max(1, len(frames) // OF_RECORDING)]]
        rooms = (frames_of(path, labels) for path in sorted(given.folder.glob(f"{ROOMS}-*.npz"))[: given.rooms])
        return [frames[:: max(1, len(frames) // OF_ROOM)] for frames in rooms]

    for source in given.sources:
        found, is_rooms = groups(source), source == ROOMS
        others = [f for frames in groups(PHOTOGRAPHS if is_rooms else ROOMS) for f in frames]
        changes = (OF_ROOMS if is_rooms else OF_RECORDINGS) | IN_BOTH
        before = score(found, lambda p, _: p, others, ask, labels)
        print(
            f"\n| {source}, {sum(map(len, found))} pictures | mIoU; total accuracy, % | change (95 %) |\n|---|---|---|"
        )
        for name, change in {"as it is": None, **changes}.items():
            if change and not any(word in name for word in given.only):
                continue
            after = score(found, change, others, ask, labels) if change else before
            figures, d = sum(after[1:], after[0]).metrics(), paired_bootstrap(after, before)
            cells = f"{100 * (figures.miou or 0):.1f}; {100 * (figures.total_accuracy or 0):.1f}"
            gain = f"{100 * d.observed:+.1f} ({100 * d.low:+.1f} to {100 * d.high:+.1f})" if change else ""
            print(f"| {name} | {cells} | {gain} |", flush=True)


if __name__ == "__main__":
    main()
