"""Look at the viewer as a person would: a map in a headless browser, and check what the picture shows.

Run by ``make test-web``. A saved map is a room whose classes are known, so the picture must hold their colours, in the
map and in the legend; and the page must have reached nobody but this machine. A launch is watched while its map grows
(``--log`` and ``--weights``: of a recording instead of a room). A page of a report is looked at, too.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from research.experiments.browser import ROOT, Browser, provide_browser
from research.experiments.web_live import look_at_live
from research.experiments.web_pictures import LARGEST, LEAST_MAP, pixels_of, take, what_is_missing
from research.scenes import TEST_SEEDS, room_frames
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.report import Section, picture, picture_files, point_view, table_of, write_page
from semantic_mapper.nodes.viewer.server import WebViewer
from semantic_mapper.nodes.viewer.sources import show_saved
from semantic_mapper.plots import Bar, class_rows, draw_bars
from semantic_mapper.replay.exporters.rerun_log import recording_server
from semantic_mapper.types import CameraIntrinsics

OUT = ROOT / "runs" / "web"
WIDTH, HEIGHT = 1280, 800
FRAMES, VOXEL_M = 24, 0.04
CAMERA = CameraIntrinsics(160.0, 160.0, 119.5, 89.5, 240, 180)
SHOWN_S, LOOK_S = 300.0, 4.0  # how long it may take, rendered without a GPU on a busy machine


def main() -> int:
    """0 where all that should be seen is seen."""
    parser = argparse.ArgumentParser(description="Look at the viewer in a headless browser.")
    parser.add_argument(
        "--log", type=Path, help="what the camera of the launch sends; a room of the benchmark's without"
    )
    parser.add_argument("--weights", type=Path, help="of the launch's mapper")
    chosen = parser.parse_args()
    if error := provide_browser():
        print(f"test-web: skipped: {error}", file=sys.stderr)
        return 0
    OUT.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    failures = look_at_viewer() + look_at_live(OUT, chosen.log, chosen.weights) + look_at_report()
    for failure in failures:
        print(f"test-web: {failure}", file=sys.stderr)
    print(f"test-web: {'failed' if failures else 'passed'} in {time.monotonic() - began:.0f} s; pictures in {OUT}")
    return int(bool(failures))


def look_at_viewer() -> list[str]:
    """Show the room, wait until it is all seen, and say what is not."""
    voxel_map = make_room()
    voxel_map.save(OUT / "map.npz")
    rows = class_rows(voxel_map.points().label, ROOMS)
    picture, left = (
        np.zeros((HEIGHT, WIDTH, 3), np.uint8),
        what_is_missing(np.zeros((HEIGHT, WIDTH, 3), np.uint8), rows),
    )
    assert len(left) == 1 + LARGEST + len(rows), "an empty picture lacks all"
    with WebViewer(0, 0) as viewer, Browser(WIDTH, HEIGHT) as browser:
        browser.open(viewer.page_url)  # before there is anything to see
        show_saved(OUT / "map.npz", lambda: recording_server(viewer.data_url))
        deadline = time.monotonic() + SHOWN_S
        while left and time.monotonic() < deadline:
            browser.wait(LOOK_S)
            picture = take(browser, OUT / "viewer.png")
            left = what_is_missing(picture, rows)
        reached = {urlsplit(url).hostname for i, url in browser.requests.items() if i not in browser.refused}
    foreign = reached - {"127.0.0.1", None}
    return left + ([f"the page has spoken to {', '.join(map(str, foreign))}"] if foreign else [])


def make_room() -> VoxelMap:
    """A room of the benchmark, fused with its true classes."""
    voxel_map = VoxelMap(VoxelMapConfig(voxel_size_m=VOXEL_M), ROOMS)
    for frame in room_frames(TEST_SEEDS[0], FRAMES, CAMERA):
        assert frame.depth_m is not None and frame.label is not None
        channels = ROOMS.to_channels(frame.label)
        sure = np.eye(len(ROOMS), dtype=np.float32)[np.maximum(channels, 0)] * 0.9 + np.float32(0.1 / len(ROOMS))
        voxel_map.integrate(frame, frame.depth_m, sure, channels >= 0)
    return voxel_map


def look_at_report() -> list[str]:
    """Open a page with the room, pictures and a table, and say what of it does not show, or does not answer."""
    points = VoxelMap.load(OUT / "map.npz").points()
    rows = [("wall", "60 %"), ("<floor> & more", "40 %")]
    bars = picture(draw_bars("stages", [Bar("p50", {"render": 20.0, "fuse": 5.0})], "ms"), "stages")
    pictures = [bars, *picture_files((OUT / "viewer.png", "the viewer"))]
    sections = [
        Section("The map", view=point_view(points, ROOMS, None)),
        Section("Figures", pictures=pictures, tables=[table_of(("class", "fraction"), rows)]),
    ]
    write_page(OUT / "report.html", "Report of a test", sections)
    largest = [row for row in class_rows(points.label, ROOMS) if row[0] != "ceiling"][:LARGEST]  # which is cut away
    with Browser(WIDTH, HEIGHT) as browser:
        browser.open((OUT / "report.html").as_uri())
        browser.wait(LOOK_S)
        seen = [pixels_of(take(browser, OUT / "report.png"), color) for _, color, _ in largest]
        browser.evaluate("document.getElementById('none').click()")
        browser.wait(LOOK_S)
        left = [pixels_of(take(browser, OUT / "report-none.png"), color) for _, color, _ in largest]
        shown = browser.evaluate("[...document.images].filter(i => i.complete && i.naturalWidth > 0).length")
        cells = browser.evaluate("[...document.querySelectorAll('td')].map(c => c.textContent).join('|')")
        asked = {urlsplit(url).scheme for url in browser.requests.values()}
        messages = browser.messages
    failures = [] if shown == 2 else [f"{shown} of 2 pictures of the report show"]
    failures += [] if cells == "wall|60 %|<floor> & more|40 %" else [f"the report's table reads {cells}"]
    failures += [f"the page says: {message}" for message in messages]
    for (name, _, _), before, after in zip(largest, seen, left, strict=True):
        if before < LEAST_MAP or after > 0.5 * before:
            failures.append(f"{name} has {before} pixels in the report's map, and {after} when hidden")
    return failures + ([] if asked <= {"file", "data"} else [f"the report asks for {sorted(asked)}"])


if __name__ == "__main__":
    sys.exit(main())
