"""What the weights do not know: pictures unlike their training rooms, and points of a map that are called unknown.

python -m research.experiments.open_set statistics              # of training pictures, into the package
python -m research.experiments.open_set pictures NAME=PATH ...  # a log, a folder of pictures or panoramas, or rooms
python -m research.experiments.open_set coverage LOG            # thresholds of voxel_map.unknown_below
python -m research.experiments.open_set kept DIR kitchen/3 flat val/2 test/2 [--plot PNG]

The last takes every so many-th frame of what ``kept_votes`` wrote to DIR: temperatures of the votes, and thresholds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from research.experiments.kept_votes import Kept, Recording, fuse, load, true_points
from research.experiments.vote_rules import log_own, votes
from research.plots import Curve, Panel, draw_panels
from research.scenes import RoomConfig, room_frames
from research.suites.config import SuiteConfig, camera_of_width, suite_seeds
from research.train.cameras import CameraDraw, draw_camera
from semantic_mapper.config import MapperConfig, VoxelMapConfig
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.evaluation.metrics import ConfidenceScores, confusion_of
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.domain_check import STATISTICS, UNLIKE, backbone_digests
from semantic_mapper.fields.encoder import EfficientNetLite0
from semantic_mapper.fields.streaming import PICTURE_WIDTH
from semantic_mapper.fields.weights import default_checkpoint_path, load_weights
from semantic_mapper.imaging import resize_label
from semantic_mapper.mapper import Mapper
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.evaluate.truth import SurfaceTruth, TruthMapper
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import Float32, Float64, UInt8

SIZE = (PICTURE_WIDTH, 120)  # as the weights see pictures
SEEDS, VIEWS, STEP_M = range(51_000, 51_450), 3, 0.35  # training rooms, and views of each
VARIETY, PEOPLE = 0.4, 0.3  # of run 6 of the shipped weights
SHRINKAGE = 0.01  # of the covariance to a multiple of the identity
TURNS_DEG, PITCH_DEG, VIEW_DEG = range(0, 360, 45), 8.0, 75.0  # of views into a panorama
COVERAGE = "kept; right of these; right of the others; lacking kept; well answered"  # of thresholds
THRESHOLDS = (0.0, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7)
TEMPERATURES, OWN_WEIGHT = (1.1, 1.2, 1.3, 1.5), 0.8  # of votes, besides 1; of the own image in them
SPLITS, MOST_ROOMS, SHORTEST_HALF = ("val", "test"), 6, 20  # frames, of recordings that are cut in two by time


def _features(pictures: Iterable[UInt8]) -> Float64:
    """(N, D) of pictures (H, W, 3) uint8, as ``DomainCheck`` takes them."""
    backbone = _backbone()
    with torch.inference_mode():
        small = (torch.from_numpy(_fitted(p)).permute(2, 0, 1).float().div(255)[None] for p in pictures)
        return np.stack([backbone(p)[-1].mean((2, 3))[0].double().numpy() for p in small])


def _backbone() -> EfficientNetLite0:
    encoder = load_checkpoint(default_checkpoint_path()).model.image_encoder
    assert encoder is not None
    return next(encoder.backbones())


def _fitted(picture: UInt8) -> UInt8:
    """Its middle, at the size and shape of ``SIZE``."""
    scale = max(SIZE[0] / picture.shape[1], SIZE[1] / picture.shape[0])
    large = [max(side, round(scale * n)) for side, n in zip(SIZE, picture.shape[1::-1], strict=True)]
    x, y = ((n - side) // 2 for n, side in zip(large, SIZE, strict=True))
    resized = cv2.resize(picture, large, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(resized[y : y + SIZE[1], x : x + SIZE[0]], np.uint8)


def _training_pictures() -> Iterator[UInt8]:
    for seed in SEEDS:
        camera = draw_camera(seed, SIZE[0], STEP_M, CameraDraw())
        room = RoomConfig(people=PEOPLE, variety=VARIETY)
        try:
            frames = list(room_frames(seed, VIEWS, camera.intrinsics, room=room, path=camera.path, noise=camera.noise))
        except SemanticMapperError:  # a room that cannot be made
            continue
        yield from (frame.rgb for frame in frames)


def _write_statistics(_: Sequence[str]) -> None:
    found = _features(_training_pictures())
    spread = np.cov(found.T)
    spread += SHRINKAGE * np.trace(spread) / len(spread) * np.eye(len(spread))
    whiten = np.linalg.cholesky(np.linalg.inv(spread)).T / np.sqrt(len(spread))
    arrays = {"mean": found.mean(0).astype(np.float32), "whiten": whiten.astype(np.float32)}
    (digest,) = backbone_digests(load_weights(default_checkpoint_path()))
    np.savez_compressed(STATISTICS, **arrays, backbone=digest)
    print(f"{STATISTICS}: of {len(found)} pictures of {len(SEEDS)} rooms")


def _pictures_at(path: str) -> Iterator[UInt8]:
    """Those of test rooms, of a log, or of a folder, whose panoramas (twice as wide as high) are looked into."""
    if path == "rooms":
        for seed in suite_seeds(SuiteConfig()):
            yield from (frame.rgb for frame in islice(room_frames(seed, 80, camera_of_width(SIZE[0])), 0, None, 10))
    elif path.endswith(".mcap"):
        with open_log(Path(path)) as log:
            yield from (frame.rgb for frame in log)
    else:
        for file in sorted(Path(path).iterdir()):
            picture = cv2.imread(str(file))
            if picture is None:
                continue
            rgb = np.asarray(picture[..., ::-1], np.uint8)
            is_panorama = rgb.shape[1] == 2 * rgb.shape[0]
            yield from (_look_into(rgb, turn) for turn in TURNS_DEG) if is_panorama else (rgb,)


def _look_into(panorama: UInt8, turn_deg: float) -> UInt8:
    height, width = panorama.shape[:2]
    u, v = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in SIZE))
    rays = np.stack((u, v, np.full_like(u, SIZE[0] / 2 / np.tan(np.radians(VIEW_DEG) / 2))), -1)
    c, s = np.cos(np.radians(PITCH_DEG)), np.sin(np.radians(PITCH_DEG))
    rays = rays @ np.array(((1, 0, 0), (0, c, -s), (0, s, c))).T / np.linalg.norm(rays, axis=-1, keepdims=True)
    x = (np.arctan2(rays[..., 0], rays[..., 2]) / (2 * np.pi) + turn_deg / 360 + 0.5) % 1 * width - 0.5
    y = (np.arcsin(rays[..., 1]) / np.pi + 0.5) * height - 0.5
    seen = cv2.remap(panorama, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(seen, np.uint8)


def _show_pictures(sources: Sequence[str]) -> None:
    check = Mapper.load().pipeline.domain_check
    assert check is not None, "run `statistics` first"
    print("| pictures | count | distance: 5 % | median | 95 % | unlike |\n|---|---|---|---|---|---|")
    for name, _, path in (source.partition("=") for source in sources):
        found = [check.distance(f.astype(np.float32)) for f in _features(_pictures_at(path))]
        low, middle, high, unlike = *np.percentile(found, (5, 50, 95)), np.mean(np.greater(found, UNLIKE))
        print(f"| {name} | {len(found)} | {low:.2f} | {middle:.2f} | {high:.2f} | {unlike:.0%} |")


def _show_coverage(sources: Sequence[str]) -> None:
    path = Path(sources[0])
    with open_log(path) as log:
        assert log.info.label_set is not None, "a log without labels"
        mapper = Mapper.load(None, MapperConfig(voxel_map=VoxelMapConfig(unknown_below=0.0)))
        surface, target = SurfaceTruth(log.info.label_set), TruthMapper(log.info.label_set, mapper.label_set)
        for frame in log:
            mapper.step(frame)
            surface.add(frame)
        points = mapper.voxel_map.points()
        labels = surface.labels_at(points.xyz)
        voted = (labels != log.info.label_set.ignore_id) & (points.confidence > 0)
        truth = target.to_map_ids(labels, str(path))[voted]
    ignore, label, confidence = mapper.label_set.ignore_id, points.label[voted], points.confidence[voted]
    print(f"{path}\n| unknown below | {COVERAGE.replace(';', ' |')}, % | mIoU |\n|{'---|' * 7}")
    for least in THRESHOLDS:
        said = np.where(confidence >= least, label, np.uint8(ignore)).astype(np.uint8)
        miou = confusion_of(truth, said, mapper.label_set, str(path)).metrics().miou or 0.0
        cells = (f"{x:.1f}" for x in (*_coverage(truth, label, confidence, ignore, least), 100 * miou))
        print(f"| {least:g} | {' | '.join(cells)} |")


def _parts(folder: Path, sources: Sequence[str]) -> dict[str, list[Recording]]:
    parts: dict[str, list[Recording]] = {}
    for name, _, every in (source.partition("/") for source in sources):
        found = [load(path, int(every or 1)) for path in sorted(folder.glob(f"{name}*.npz"))[:MOST_ROOMS]]
        whole, half = found[0], len(found[0].frames) // 2
        if len(found) > 1 or half < SHORTEST_HALF:
            parts[name] = found
        else:
            parts[f"{name}, first half"] = [whole._replace(frames=whole.frames[:half])]
            parts[f"{name}, second half"] = [whole._replace(frames=whole.frames[half:])]
    return parts


def _entropy(kept: Kept) -> float:
    """Of what the own image says, nats, mean over its pixels."""
    return float(-(np.exp(log_own(kept)) * log_own(kept)).sum(2).mean())


def _tempered(p: Float32, temperature: float) -> Float32:
    p = p ** np.float32(1 / temperature)
    return p / p.sum(axis=2, keepdims=True)


def _voted(recordings: Sequence[Recording], of: Callable[[Kept], float]) -> tuple[UInt8, UInt8, Float32, float]:
    """True and voted ids and confidences of the points of maps by some temperatures; and the ECE of frames."""
    found, sure, vote = [], ConfidenceScores(), votes(OWN_WEIGHT)
    for recording in recordings:
        labels, points = recording.label_set, fuse(recording, lambda k, m: _tempered(vote(k, m), of(k)))[0].points()
        truth, counts = true_points(recording, points)
        found.append((truth[counts], points.label[counts], points.confidence[counts]))
        for kept in recording.frames:
            truth, p = resize_label(np.asarray(kept.frame.label), kept.coarse), _tempered(kept.rendered, of(kept))
            at = kept.known & (truth != labels.ignore_id)
            sure.update(p.max(2)[at], (labels.to_ids(p.argmax(2)) == truth)[at], np.zeros(at.sum(), np.bool_))
    truth, label, confidence = (np.concatenate(column) for column in zip(*found, strict=True))
    return truth, label, confidence, sure.calibration_error or 0.0


def _coverage(truth: UInt8, label: UInt8, confidence: Float32, ignore: int, least: float) -> list[float]:
    """Of points, in %: the figures of ``COVERAGE``; well answered is right, or unknown where there is no class."""
    known, kept, right = truth != ignore, confidence >= least, truth == label
    answered = np.where(known, kept & right, ~kept)
    of = (kept[known], right[known & kept], right[known & ~kept], kept[~known], answered)
    return [100 * float(x.mean()) if len(x) else float("nan") for x in of]


def _show_kept(sources: Sequence[str], plot: Path | None) -> None:
    parts = _parts(Path(sources[0]), sources[1:])
    ignore = next(iter(parts.values()))[0].label_set.ignore_id
    check, tail = Mapper.load().pipeline.domain_check, f"{' | '.join(parts)} |\n|{'---|' * (1 + len(parts))}"
    assert check is not None, "run `statistics` first"
    frames = {name: [kept for r in of for kept in r.frames] for name, of in parts.items()}
    entropy = {name: [_entropy(kept) for kept in of] for name, of in frames.items()}
    features = {name: _features(kept.frame.rgb for kept in of) for name, of in frames.items()}
    distance = {name: [check.distance(f.astype(np.float32)) for f in of] for name, of in features.items()}
    print(f"| median over frames (AUROC of photographs) | {tail}")
    for title, values in {"mean entropy of the own image": entropy, "distance of features": distance}.items():
        rooms = np.concatenate([v for name, v in values.items() if name in SPLITS])
        photographs = np.concatenate([v for name, v in values.items() if name not in SPLITS])
        auroc, cells = (photographs[:, None] > rooms).mean(), [f"{np.median(v):.2f}" for v in values.values()]
        print(f"| {title} ({auroc:.3f}) | {' | '.join(cells)} |")
    maps = {name: _voted(of, lambda _: 1.0) for name, of in parts.items()}
    print(f"\n| unknown below: {COVERAGE}, % | {tail}")
    for least in THRESHOLDS:
        cells = ["; ".join(f"{x:.1f}" for x in _coverage(*of[:3], ignore, least)) for of in maps.values()]
        print(f"| {least:g} | {' | '.join(cells)} |", flush=True)
    if plot:
        curves = {n: [_coverage(*of[:3], ignore, t) for t in np.linspace(0.95, 0, 96)] for n, of in maps.items()}
        right = [Curve(name, [(x[0], x[1]) for x in curve]) for name, curve in curves.items()]
        lacking = [Curve(n, [(x[0], x[3]) for x in c]) for n, c in curves.items() if np.isfinite(c[0][3])]
        titles = {"right of these, %": right, "kept of classes that the map lacks, %": lacking}
        write_picture(plot, draw_panels("", [Panel("", y, "kept, %", of) for y, of in titles.items()]))
    limit = float(np.percentile(entropy[SPLITS[0]], 95))
    rules: dict[str, Callable[[Kept], float]] = {f"{t:g}": lambda _, t=t: t for t in TEMPERATURES}
    rules[f"1.2 of frames of an entropy above {limit:.2f}"] = lambda kept: 1.2 if _entropy(kept) > limit else 1.0
    print(f"\n| temperature: ECE of frames; of points, % | {tail}")
    for rule in ("1", *rules):
        maps = {name: _voted(of, rules[rule]) for name, of in parts.items()} if rule in rules else maps
        cells: list[str] = []
        for truth, label, confidence, ece in maps.values():
            sure = ConfidenceScores()
            sure.update(confidence, label == truth, truth == ignore)
            cells.append(f"{100 * ece:.1f}; {100 * (sure.calibration_error or 0):.1f}")
        print(f"| {rule} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Write statistics, or show a table, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("statistics", "pictures", "coverage", "kept"))
    parser.add_argument("sources", nargs="*")
    parser.add_argument("--plot", type=Path, metavar="PNG")
    given = parser.parse_args()
    shows = {"statistics": _write_statistics, "pictures": _show_pictures, "coverage": _show_coverage}
    shows["kept"] = partial(_show_kept, plot=given.plot)
    shows[given.what](given.sources)


if __name__ == "__main__":
    main()
