"""What the weights do not know: pictures unlike their training rooms, and points of a map that are called unknown.

python -m research.experiments.open_set statistics              # of training pictures, into the package
python -m research.experiments.open_set pictures NAME=PATH ...  # a log, a folder of pictures or panoramas, or rooms
python -m research.experiments.open_set coverage LOG            # thresholds of voxel_map.unknown_below
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from research.scenes import RoomConfig, room_frames
from research.suites.config import SuiteConfig, camera_of_width, suite_seeds
from research.train.cameras import CameraDraw, draw_camera
from semantic_mapper.config import MapperConfig, VoxelMapConfig
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.evaluation.metrics import confusion_of
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.domain_check import STATISTICS, UNLIKE, backbone_digests
from semantic_mapper.fields.encoder import EfficientNetLite0
from semantic_mapper.fields.streaming import PICTURE_WIDTH
from semantic_mapper.fields.weights import default_checkpoint_path, load_weights
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.evaluate.truth import SurfaceTruth, TruthMapper
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import Float64, UInt8

SIZE = (PICTURE_WIDTH, 120)  # as the weights see pictures
SEEDS, VIEWS, STEP_M = range(51_000, 51_450), 3, 0.35  # training rooms, and views of each
VARIETY, PEOPLE = 0.4, 0.3  # of run 6 of the shipped weights
SHRINKAGE = 0.01  # of the covariance to a multiple of the identity
TURNS_DEG, PITCH_DEG, VIEW_DEG = range(0, 360, 45), 8.0, 75.0  # of views into a panorama
THRESHOLDS = (0.0, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7)


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
    known, right = truth != ignore, truth == label
    print(f"{path}\n| unknown below | kept | right of these | right of those called unknown | mIoU | lacking kept |")
    print("|---|---|---|---|---|---|")
    for threshold in THRESHOLDS:
        kept = confidence >= threshold
        said = np.where(kept, label, np.uint8(ignore)).astype(np.uint8)
        miou = confusion_of(truth, said, mapper.label_set, str(path)).metrics().miou or 0.0
        parts = kept[known], right[known & kept], right[known & ~kept], kept[~known]
        share, of_kept, of_unknown, lacking = (f"{100 * p.mean():.1f} %" if len(p) else "-" for p in parts)
        print(f"| {threshold:g} | {share} | {of_kept} | {of_unknown} | {100 * miou:.1f} | {lacking} |")


def main() -> None:
    """Write statistics, or show a table, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("statistics", "pictures", "coverage"))
    parser.add_argument("sources", nargs="*")
    given = parser.parse_args()
    {"statistics": _write_statistics, "pictures": _show_pictures, "coverage": _show_coverage}[given.what](given.sources)


if __name__ == "__main__":
    main()
