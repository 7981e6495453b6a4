"""A map through a real V4L2 camera: Debian's kernel in QEMU, a film in its virtual camera, poses on the pose topic.

A walk through a ROOMS room is rendered. In the virtual machine the kernel's ``vivid`` shows it to its own camera
(``v4l2_film.py``), the camera node reads that through the V4L2 driver and publishes posed frames. On this machine,
which reaches it over TCP, a mapper node maps them with computed depth, and a recorder node keeps them. Maps are
measured against the true surface, beside maps of the same frames with the pictures as rendered.

Example: python -m research.experiments.v4l2_map --out runs/v4l2
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from research.experiments import v4l2_machine
from research.experiments.computed_maps import distances, true_surface
from research.scenes import TEST_SEEDS, CameraPathConfig, NoiseConfig
from research.scenes.sequence import room_views
from semantic_mapper.config import MapperConfig, convert_config
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.replay.session import MapSession
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

FILM = Path(__file__).resolve().with_name("v4l2_film.py")
WIDTH, HEIGHT, FOCAL = 640, 480, 882.5 / 1280  # the smallest picture that ``vivid`` shows; an OAK-D's lens
VIVID = "node_types=0x101 num_inputs=1 input_types=0x3 num_outputs=1 output_types=0x1"  # HDMI both
VIVID_HZ = 59.94
WEIGHTS = "rooms-computed-depth"  # as ``launch/webcam.toml`` has it
TRUTH_M = 0.15  # way between the views that the true surface is made of, and ...
EVERY_POINT = 20  # ... which of their pixels are taken
A_FRAME = 4  # pictures of the film that are shown, at most, for each frame that the camera node has published
PATIENCE_S = 600.0


class Walk(NamedTuple):
    """Pictures (N, H, W, 3) as rendered, the poses of the camera (N, 4, 4), and the true surface (M, 3)."""

    pictures: UInt8
    poses: Float64
    surface: Float64


def render_walk(seed: int, count: int, step_m: float, camera: CameraIntrinsics) -> Walk:
    """A walk through a room of a seed."""
    pictures, poses, truth = list[UInt8](), list[Float64](), list[tuple[Float32, CameraIntrinsics, Float64]]()
    noise, every = NoiseConfig(depth="none"), max(1, round(TRUTH_M / step_m))
    for n, view in enumerate(room_views(seed, count, camera, path=CameraPathConfig(step_m=step_m), noise=noise)):
        pictures.append(view.frame.rgb)
        poses.append(view.T_world_camera)
        if n % every == 0:
            truth.append((view.rendered.exact_depth_m, camera, view.T_world_camera))
    return Walk(np.stack(pictures), np.stack(poses), true_surface(truth, EVERY_POINT))


def film_settings(walk: Walk, folder: Path, camera: CameraIntrinsics, port: int, hz: float) -> Path:
    """Write what the guest reads: film, poses, calibration, and the job of its camera node."""
    yuyv = [cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_YUYV) for picture in walk.pictures]
    np.save(folder / "film.npy", np.stack(yuyv).reshape(len(yuyv), -1))
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "camera.toml").write_text("".join(f"{name} = {value}\n" for name, value in numbers.items()))
    v4l2 = {"calibration": str(folder / "camera.toml"), "fourcc": "YUYV", "fps": VIVID_HZ}
    # The guest is slow: a picture may be read seconds after it was captured, and its pose may come after that.
    poses = {"kind": "topic", "wait_s": 1.0, "max_clock_difference_s": 5.0}
    job = {
        "name": "camera",
        "options": {"camera": {"kind": "v4l2", "config": v4l2, "poses": poses}},
        "endpoints": {"camera": f"tcp://127.0.0.1:{port}"},
        "subscribers": 2,
    }
    told = {
        "hz": hz,
        "a_frame": A_FRAME,
        "positions": walk.poses[:, :3, 3].tolist(),
        "quaternions": Rotation.from_matrix(walk.poses[:, :3, :3]).as_quat().tolist(),
    }
    settings = {"pictures": str(folder / "film.npy"), "walk": told, "job": job}
    path = folder / "film.json"
    path.write_text(json.dumps(settings), encoding="utf-8")
    return path


@contextmanager
def node(kind: str, options: dict[str, Any], endpoints: dict[str, str], log: Path) -> Iterator[None]:
    """A node of ours in a process of its own, waited for at the end.

    Raises:
        SystemExit: it failed.
    """
    job = json.dumps({"name": kind, "options": options, "endpoints": endpoints})
    with log.open("w", encoding="utf-8") as told:
        process = subprocess.Popen([sys.executable, "-m", f"semantic_mapper.nodes.{kind}", job], stderr=told)
        try:
            yield
            code = process.wait(PATIENCE_S)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    if code != 0:
        raise SystemExit(f"the {kind} ended with {code}: see {log}")


def run_nodes(settings: Path, out: Path, port: int) -> list[PosedFrame]:
    """Camera in the guest, mapper and recorder here; the frames that were published."""
    endpoints = {"camera": f"tcp://127.0.0.1:{port}", "mapper": f"ipc://{settings.parent}/mapper"}
    mapper = {"out": str(out / "live"), "delivery": "all", "weights": WEIGHTS, "query": ""}
    recorder = {"out": str(out / "frames.mcap"), "sources": ["camera"], "overwrite": True}
    with (
        node("mapper", mapper, endpoints, out / "mapper.log"),
        node("recorder", recorder, endpoints, out / "recorder.log"),
    ):
        guest = v4l2_machine.Guest((str(FILM), str(settings)), VIVID, port, PATIENCE_S)
        if v4l2_machine.run(guest) != 0:
            raise SystemExit("the camera node failed: see above")
    with LogReader(out / "frames.mcap") as log:
        return list(log)


def map_frames(frames: Iterable[PosedFrame], refined: bool, out: Path | None = None) -> Float32:
    """Points (N, 3) of a map of frames, made as the mapper node makes it."""
    config = convert_config({"depth": {"refine_poses": refined}}, MapperConfig, "settings")
    session = MapSession(Mapper.load(WEIGHTS, config), stream_labels=None)
    for frame in frames:
        session.process(frame)
    if out is None:
        session.process_rest()
    else:
        session.finish(out)
    return session.pipeline.voxel_map.points().xyz


def which_picture(frame: PosedFrame, poses: Float64) -> int:
    """The picture of the film that a frame's pose is of."""
    return int(np.argmin(np.abs(poses - frame.T_world_camera).max((1, 2))))


def shows_it(frame: PosedFrame, walk: Walk, index: int) -> bool:
    """Whether no neighbour of a picture of the film is more like the frame than itself."""
    near = range(max(0, index - 2), min(len(walk.pictures), index + 3))
    unlike = {n: float(np.abs(walk.pictures[n].astype(np.int16) - frame.rgb).mean()) for n in near}
    return unlike[index] <= min(unlike.values())


def main() -> int:
    """Run it, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for map, log and pictures")
    parser.add_argument("--seed", type=int, default=TEST_SEEDS[0], help="of room and walk")
    parser.add_argument("--pictures", type=int, default=240, help="of the film")
    parser.add_argument("--step", type=float, default=0.0125, help="metres between two of them")
    parser.add_argument("--hz", type=float, default=6.0, help="pictures of the film a second, at most")
    given = parser.parse_args()
    if error := v4l2_machine.fetch():
        print(f"v4l2_map: skipped: {error}", file=sys.stderr)
        return 0
    given.out.mkdir(parents=True, exist_ok=True)
    focal = FOCAL * WIDTH
    camera = CameraIntrinsics(focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
    walk = render_walk(given.seed, given.pictures, given.step, camera)
    with tempfile.TemporaryDirectory(prefix="v4l2-map-") as folder, socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
        free.close()
        frames = run_nodes(film_settings(walk, Path(folder), camera, port, given.hz), given.out, port)
    shown = [which_picture(frame, walk.poses) for frame in frames]
    rendered = [replace(frame, rgb=walk.pictures[n]) for frame, n in zip(frames, shown, strict=True)]
    middle = len(frames) // 2
    write_picture(given.out / "captured.png", np.hstack([frames[middle].rgb, rendered[middle].rgb]))
    maps = {
        "through the camera, live": VoxelMap.load(given.out / "live" / "map.npz").points().xyz,
        "as rendered": map_frames(rendered, True, given.out / "rendered"),
        "through the camera, poses as given": map_frames(frames, False),
        "as rendered, poses as given": map_frames(rendered, False),
    }
    summary = json.loads((given.out / "live" / "summary.json").read_text(encoding="utf-8"))
    unlike = [np.abs(f.rgb.astype(np.int16) - r.rgb).mean() for f, r in zip(frames, rendered, strict=True)]
    figures = {
        "pictures of the film": len(walk.pictures),
        "frames": {"published": len(frames), **summary["frames"]},
        "pictures of the film that they show": len(set(shown)),
        "frames whose pose is of another picture": sum(
            not shows_it(frame, walk, n) for frame, n in zip(frames, shown, strict=True)
        ),
        "captured from rendered pictures, grey levels of 255 (mean)": round(float(np.mean(unlike)), 2),
        "maps": {
            name: {"points": len(xyz), **{key: round(value, 3) for key, value in distances(xyz, walk.surface).items()}}
            for name, xyz in maps.items()
        },
    }
    (given.out / "v4l2_map.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(figures, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
