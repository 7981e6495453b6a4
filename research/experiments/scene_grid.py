"""Fit scene grids: held-out PSNR, CPU time and memory, on one thread.

objects: 70 views of 72x72 of matte objects before white. rooms: 40 frames
with depth, beside semantic_nerf at the same CPU time.

Example: python -m research.experiments.scene_grid objects --scenes 4 --out runs/grid
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import torch

from research.experiments.grid_scenes import BOX_M, object_frames, objects_scene
from research.peers.kinds import build_field
from research.peers.semantic_nerf import config_for_scene
from research.scenes import VALIDATION_SEEDS, NoiseConfig
from research.scenes.sequence import room_views
from semantic_mapper.config import GridFieldConfig, SamplingConfig
from semantic_mapper.fields.device import DeviceField
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.render import View, render_image
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.fields.weights import anchor_from_frame
from semantic_mapper.imaging import resize_depth
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.grid_fit import OPACITY, fit_grid, psnr_of
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame

HELD_OUT_OBJECTS = 10
ROOM_FRAMES, ROOM_EVERY = 40, 5  # one frame in five is held out
ROOM_CAMERA = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)
HELD_OUT_WIDTH = 80
PICTURE_PX, HEADING_PX = 200, 30  # of a picture's width, about, and of a line of text
FREE = SamplingConfig(mode="reference", coarse=32, fine=32)  # no depth prior where a view is new


def measure_objects(seed: int, out: Path | None, settings: GridFitConfig) -> str:
    """Fit a scene of objects; held-out views are 10 others."""
    frames = object_frames(objects_scene(seed), 70 + HELD_OUT_OBJECTS, seed)
    held_out = frames[70:]
    own = {"box_m": BOX_M, "near_m": 1.0, "exposure": False, "held_out": 0}
    began = time.process_time()
    fit = fit_grid(frames[:70], FinetuneConfig(seconds=0, grid=msgspec.structs.replace(settings, **own)))
    seconds = time.process_time() - began
    field = _as_field(fit.grid.state_dict(), GridFieldConfig(grid=fit.grid.config), fit.steps)
    renders = [_render(field, f) for f in held_out]
    _picture(out, f"objects-{seed}", held_out, renders)
    bits = hashlib.sha256(fit.grid.values.detach().numpy().tobytes()).hexdigest()[:12]
    return f"| objects {seed} | {_psnr(held_out, renders):.1f} | {seconds:.1f} | {_memory()} | {bits} |"


def measure_room(seed: int, out: Path | None, settings: GridFitConfig) -> list[str]:
    """Fit 32 of 40 frames with depth by a grid, then by semantic_nerf in as many CPU seconds."""
    views = list(room_views(seed, ROOM_FRAMES, ROOM_CAMERA, noise=NoiseConfig()))
    exact = [replace(v.frame, depth_m=v.rendered.exact_depth_m) for v in views[ROOM_EVERY - 1 :: ROOM_EVERY]]
    held_out = [anchor_from_frame(f, HELD_OUT_WIDTH) for f in exact]
    seen = [v.frame for i, v in enumerate(views) if (i + 1) % ROOM_EVERY]
    grid = msgspec.structs.replace(settings, held_out=0)
    began = time.process_time()
    settings_of_grid = FinetuneConfig(seconds=0, steps=grid.steps, width=160, grid=grid)
    fitted: LearnedField = finetune(seen, ROOMS, None, settings_of_grid, kind="grid").model
    seconds = time.process_time() - began
    rows = [_room_row(f"grid, room {seed}", fitted, held_out, seconds, out)]
    limit = time.process_time() + seconds
    config = FinetuneConfig(seconds=0, steps=10**6, width=160, patience=0, evaluations=1)
    box = config_for_scene(stack_sources([view_from_frame(f, ROOMS, 160) for f in seen]), 8.0)
    torch.manual_seed(0)
    nerf = finetune(
        seen, ROOMS, build_field("semantic_nerf", box, ROOMS), config, None, lambda: time.process_time() > limit
    ).model
    rows.append(_room_row(f"semantic_nerf, room {seed}", nerf, held_out, seconds, out))
    return rows


def _room_row(name: str, field: LearnedField, held_out: Sequence[PosedFrame], seconds: float, out: Path | None) -> str:
    renders = [_render(field, f) for f in held_out]
    _picture(out, name.replace(", ", "-").replace(" ", "-"), held_out, renders)
    exact = [resize_depth(f, f.intrinsics) for f in held_out]
    errors = np.concatenate([np.abs(r[1] - d)[d > 0] for r, d in zip(renders, exact, strict=True)])
    figures = f"{_psnr(held_out, renders, gain=True):.1f} | {100 * np.median(errors):.1f} | {100 * errors.mean():.1f}"
    return f"| {name} | {figures} | {seconds:.1f} |"


def _as_field(state: dict[str, torch.Tensor], config: GridFieldConfig, steps: int) -> GridField:
    field = GridField(config, ROOMS)
    field.grid.load_state_dict(state)
    field.fitted_steps += steps
    return field.eval()


def _render(field: LearnedField, frame: PosedFrame) -> tuple[Float32, Float32]:
    """Colour and depth of a view, without a depth prior."""
    k = frame.intrinsics
    sources = field.encode(stack_sources([view_from_frame(frame, ROOMS, k.width)]))
    renderer = DeviceField(field, torch.device("cpu"), FREE)
    none = np.zeros((k.height, k.width), np.float32)
    found = render_image(View(renderer, sources, k, frame.T_world_camera, none, FREE))
    return found.rgb.reshape(k.height, k.width, 3), found.depth_m.reshape(k.height, k.width)


def _psnr(frames: Sequence[PosedFrame], renders: Sequence[tuple[Float32, Float32]], *, gain: bool = False) -> float:
    """dB of all views; ``gain``: each with the factor a channel that fits it best, as the camera's exposure drifts."""
    errors: list[float] = []
    for frame, (colour, _) in zip(frames, renders, strict=True):
        truth = frame.rgb / np.float32(255)
        scale = (colour * truth).sum((0, 1)) / np.maximum((colour**2).sum((0, 1)), 1e-6) if gain else 1.0
        errors.append(float(np.square(colour * scale - truth).mean()))
    return psnr_of(float(np.mean(errors)))


def _memory() -> str:
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9:.2f} GB"  # it counts in KiB


def _picture(
    out: Path | None, name: str, frames: Sequence[PosedFrame], renders: Sequence[tuple[Float32, Float32]]
) -> None:
    """Up to four views, two in a row, each as truth, render and depth; as PNG."""
    if out is None:
        return
    out.mkdir(parents=True, exist_ok=True)
    views = []
    for frame, (colour, depth) in list(zip(frames, renders, strict=True))[:4]:
        near = np.clip(1 - depth / max(float(depth.max()), 1e-3), 0, 1)  # near is bright, nothing is black
        grey = np.repeat((255 * np.where(depth > 0, 0.1 + 0.9 * near, 0)).astype(np.uint8)[..., None], 3, 2)
        parts = (frame.rgb, (np.clip(colour, 0, 1) * 255).astype(np.uint8), grey)
        scale = max(1, round(PICTURE_PX / frame.rgb.shape[1]))
        views.append(np.hstack([np.kron(part, np.ones((scale, scale, 1), np.uint8)) for part in parts]))
    rows = [np.hstack(views[n : n + 2]) for n in range(0, len(views) - 1, 2)]
    heading = np.full((HEADING_PX, rows[0].shape[1], 3), 255, np.uint8)
    for n, text in enumerate((f"{name}: truth", "render", "depth", "truth", "render", "depth")):
        place = (n * rows[0].shape[1] // 6 + 6, HEADING_PX - 10)
        cv2.putText(heading, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.imwrite(str(out / f"{name}.png"), np.vstack((heading, *rows))[..., ::-1])


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("objects", "rooms"))
    parser.add_argument("--scenes", type=int, default=1)
    parser.add_argument("--steps", type=int, default=GridFitConfig().steps)
    parser.add_argument("--out", type=Path, help="folder for pictures: truth, render, depth")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    settings = GridFitConfig(steps=args.steps, opacity=OPACITY)  # objects stand before a sky
    if args.what == "rooms":
        print("| field | PSNR, dB | depth error, median, cm | mean, cm | CPU s |\n|---|---|---|---|---|")
        for seed in VALIDATION_SEEDS[: args.scenes]:
            print("\n".join(measure_room(seed, args.out, settings)), flush=True)
        return
    print("| scene | PSNR, dB | CPU s | peak memory | digest |\n|---|---|---|---|---|")
    for seed in range(1, args.scenes + 1):
        print(measure_objects(seed, args.out, settings), flush=True)


if __name__ == "__main__":
    main()
