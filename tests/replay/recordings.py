"""Small recordings in each foreign format, written to disk."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.labels import NYU40

WIDTH, HEIGHT = 32, 24
INTRINSICS = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "depth_scale": 1000.0}
CLASSES = {"0": "ignore", "1": "wall", "2": "floor", "5": "chair"}


def color(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """BGR, smooth, different for each frame."""
    v, u = np.mgrid[:height, :width]
    return np.stack((u * 255 // width, v * 255 // height, np.full_like(u, number * 20)), -1).astype(np.uint8)


def depth(number: int) -> np.ndarray:
    return (1000 + 10 * number + np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)).astype(np.uint16)


def label(number: int) -> np.ndarray:
    ids = np.array((0, 1, 2, 5), np.uint8)
    return ids[(np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) // 7 + number) % 4]


def pose(number: int) -> np.ndarray:
    angle = 0.1 * number
    T_world_camera = np.eye(4)
    T_world_camera[:2, :2] = ((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))
    T_world_camera[:3, 3] = (0.05 * number, -0.02 * number, 1.5)
    return T_world_camera


def write_image(file: Path, image: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), image)


def pose_row(number: int) -> str:
    return " ".join(repr(float(x)) for x in pose(number).ravel())


def make_folder(folder: Path, count: int = 6, suffix: str = "jpg") -> Path:
    for i in range(count):
        write_image(folder / "color" / f"{i:06d}.{suffix}", color(i))
        write_image(folder / "depth" / f"{i:06d}.png", depth(i))
        write_image(folder / "label" / f"{i:06d}.png", label(i))
    (folder / "poses.txt").write_text("\n".join(pose_row(i) for i in range(count)) + "\n")
    (folder / "intrinsics.json").write_text(json.dumps(INTRINSICS))
    (folder / "labels.json").write_text(json.dumps({"id_space": "NYU40", "classes": CLASSES, "ignore": 0}))
    return folder


def make_tum(folder: Path, count: int = 6) -> Path:
    """30 Hz images, poses at 100 Hz turning about z; depth 4 ms after colour."""
    start = 1_305_031_102_175_304_000
    rgb, depths, truth = ["# color images"], ["# depth maps"], ["# timestamp tx ty tz qx qy qz qw"]
    for i in range(count):
        ns = start + i * 33_333_333
        write_image(folder / "rgb" / f"{seconds(ns)}.png", color(i))
        write_image(folder / "depth" / f"{seconds(ns + 4_000_000)}.png", depth(i) * 5)
        rgb.append(f"{seconds(ns)} rgb/{seconds(ns)}.png")
        depths.append(f"{seconds(ns + 4_000_000)} depth/{seconds(ns + 4_000_000)}.png")
    for k in range(-2, count * 4 + 2):
        ns = start + k * 10_000_000
        half = tum_angle(ns - start) / 2
        truth.append(f"{seconds(ns)} {(ns - start) / 1e9:.9f} 0 1.5 0 0 {np.sin(half):.12f} {np.cos(half):.12f}")
    for name, lines in (("rgb", rgb), ("depth", depths), ("groundtruth", truth)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "intrinsics.json").write_text(json.dumps({**INTRINSICS, "depth_scale": 5000.0}))
    return folder


def tum_angle(ns: int) -> float:
    return 0.5 * ns / 1e9


def seconds(ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9 // 1000:06d}"


def make_scannet(folder: Path, count: int = 6, step: int = 20) -> Path:
    """Colour and labels are twice as large as depth, as the sensor's are."""
    for i in range(count):
        n = i * step
        write_image(folder / "color" / f"{n}.jpg", color(i, 2 * WIDTH, 2 * HEIGHT))
        write_image(folder / "depth" / f"{n}.png", depth(i))
        large = np.repeat(np.repeat(label(i), 2, 0), 2, 1)
        write_image(folder / "label-filt" / f"{n}.png", large)
        (folder / "pose").mkdir(exist_ok=True)
        (folder / "pose" / f"{n}.txt").write_text("\n".join(" ".join(map(repr, row)) for row in pose(i).tolist()))
    (folder / "intrinsic").mkdir()
    write_matrix(folder / "intrinsic" / "intrinsic_depth.txt", 30.0, 31.0, 15.5, 11.5)
    # The same rays at twice the size; pixel centres are integers.
    write_matrix(folder / "intrinsic" / "intrinsic_color.txt", 60.0, 62.0, 31.5, 23.5)
    return folder


def write_matrix(file: Path, fx: float, fy: float, cx: float, cy: float) -> None:
    file.write_text(f"{fx} 0 {cx} 0\n0 {fy} {cy} 0\n0 0 1 0\n0 0 0 1\n")


def nyu40_color(name: str) -> tuple[int, int, int]:
    return NYU40.colors[NYU40.names.index(name)]
