"""A launch that runs, watched in a headless browser while its map grows."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import msgspec

from research.experiments.browser import Browser
from research.experiments.live_launch import COMMAND, LiveLaunch, Told
from research.experiments.web_pictures import empty_images, map_pixels, take, what_is_missing
from research.scenes import TEST_SEEDS, room_frames
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import class_rows
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, PosedFrame

WIDTH, HEIGHT = 1500, 1000
FRAMES, HZ = 60, 1.0  # slow, because the browser renders without a GPU beside it
CAMERA = CameraIntrinsics(220.0, 220.0, 159.5, 119.5, 320, 240)
LOOK_S = 4.0
GROWTH = 1.2  # the map comes to this many times the pixels of the first one seen, before the eye moves back in the end


def look_at_live(out: Path, log: Path | None, weights: Path | None) -> list[str]:
    """Show a launch while it maps, and say what of it cannot be seen.

    Args:
        out: Folder for its results, and for ``live.png``.
        log: Its frames, sixty at most, are what the camera sends; without one a room of the benchmark's.
        weights: Of the mapper; without a file the small ones in the package.
    """
    shutil.rmtree(out / "launch", ignore_errors=True)  # of an earlier call: a recorder writes over nothing
    slow = write_slow_log(out / "slow.mcap", log)
    settings = [f"camera.log={slow}", "mapper.save_every_s=0", *([f"mapper.weights={weights}"] if weights else [])]
    with LiveLaunch(settings, out / "launch") as launch:
        folder = launch.sockets()
        viewer = subprocess.Popen(
            [str(COMMAND), "view", folder, "--port", "0", "--data-port", "0"], stdout=subprocess.PIPE, text=True
        )
        assert viewer.stdout is not None
        try:
            told = Told(viewer.stdout)
            with Browser(WIDTH, HEIGHT) as browser:
                browser.open(told.wait("watch at")[1].split("watch at ")[1].strip())
                return _watch(launch, told, browser, out)
        finally:
            viewer.terminate()
            viewer.wait()


def write_slow_log(path: Path, log: Path | None) -> Path:
    """Sixty frames at most, without labels, a second between them."""
    if log is None:
        frames: Sequence[PosedFrame] = list(room_frames(TEST_SEEDS[0], FRAMES, CAMERA))
        info = StreamInfo("a room", {frames[0].camera_id: CAMERA}, ROOMS, len(frames), HZ)
    else:
        with LogReader(log) as reader:
            step = max(1, len(reader) // FRAMES)
            frames = [frame for i, frame in enumerate(reader) if i % step == 0][:FRAMES]
            info = msgspec.structs.replace(reader.info, frame_count=len(frames), frame_hz=HZ)
    with LogWriter(path, info, overwrite=True) as writer:
        for seq, frame in enumerate(frames):
            stamp_ns = round((seq + 1) * 1e9 / HZ)
            writer.write_frame(dataclasses.replace(frame, seq=seq, stamp_ns=stamp_ns, label=None))
    return path


def _watch(launch: LiveLaunch, told: Told, browser: Browser, out: Path) -> list[str]:
    """Look again and again until the stream has ended."""
    seen: list[int] = []  # coloured pixels of the map's view, over time
    complete = False  # all images were seen while it ran
    while told.last("the stream has ended") is None and launch.process.poll() is None:
        browser.wait(LOOK_S)
        picture = take(browser, out / f"live-{len(seen)}.png")
        complete = complete or not empty_images(picture)
        seen.append(map_pixels(picture))
    launch.process.wait()
    told.wait("the stream has ended")
    browser.wait(3 * LOOK_S)
    picture = take(browser, out / "live.png")
    voxel_map = VoxelMap.load(launch.out / "map.npz")
    rows = class_rows(voxel_map.points().label, voxel_map.label_set)
    failures = what_is_missing(picture, rows) + empty_images(picture)
    if not complete:
        failures.append("no picture that was taken while it ran has all images of the camera")
    if not seen or max(seen) < GROWTH * next(filter(None, seen), 1):
        failures.append(f"the map has not grown while it was watched: {seen} coloured pixels")
    return failures
