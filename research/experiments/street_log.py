"""A street of STREETS as files, for the command line: what annotators and a camera would give, and the truth.

``OUT/street.mcap`` has both cameras, measured depth of the left one and its predicted labels; ``OUT/truth.mcap`` the
left images with true labels; ``OUT/boxes.json`` the annotated boxes.

Example: python -m research.experiments.street_log --street 200000 --out runs/street
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from research.scenes.suite import STREETS_SUITE
from research.suites.streets import StreetsConfig, drive, evaluated, primitive
from semantic_mapper.replay.boxes import BoxFile, save_boxes
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--street", type=int, default=STREETS_SUITE.seeds["test"][0])
    parser.add_argument("--moving", action="store_true", help="cars drive")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    street = drive(StreetsConfig(moving=given.moving), given.street)
    given.out.mkdir(parents=True, exist_ok=True)
    left = [replace(frame, label_is_pseudo=True) for frame in street.frames()]
    pairs = zip(left, (view.frame for view in street.right), strict=True)
    write(given.out / "street.mcap", given.street, [frame for pair in pairs for frame in pair])
    true = [replace(view.frame, label=evaluated(view.rendered.label)) for view in street.left]
    write(given.out / "truth.mcap", given.street, true)
    save_boxes(given.out / "boxes.json", BoxFile(tuple(primitive(box) for box in street.boxes)))


def write(path: Path, street: int, frames: list[PosedFrame]) -> None:
    """A log of frames with labels of the suite's classes."""
    cameras = {frame.camera_id: frame.intrinsics for frame in frames}
    with LogWriter(path, StreamInfo(f"street {street}", cameras, STREETS_SUITE.label_set), overwrite=True) as writer:
        for frame in frames:
            writer.write_frame(frame)


if __name__ == "__main__":
    main()
