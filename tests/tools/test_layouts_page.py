"""``docs/layouts.md`` shows what the readers read."""

import re
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.replay.importers.run import FORMATS, detect_format
from tests.replay.recordings import imported, write_image
from tools.layouts_page import LAYOUTS, PAGE, files_of, page


def write(file: Path, text: str) -> None:
    what, _, example = text.partition("\n")
    file.parent.mkdir(parents=True, exist_ok=True)
    shape = tuple(map(int, re.findall(r"(\d+)x(\d+)", f"{what} 640x480")[0][::-1]))
    if example:
        file.write_text(example)
    elif file.suffix == ".bin":
        np.full((1, 4), 5, "<f4").tofile(file)
    elif what.startswith("colour"):
        write_image(file, np.full((*shape, 3), 90, np.uint8))
    else:
        write_image(file, np.full(shape, 1, np.uint16 if what.startswith("depth") else np.uint8))


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "rosbag"])
def test_what_the_page_shows_of_a_format_is_imported_whole(tmp_path: Path, name: str) -> None:
    files = LAYOUTS[name]["files"]
    for path, text in files.items():
        for file in files_of(path):
            write(tmp_path / "recording" / file, text)
    assert detect_format(tmp_path / "recording") == name
    report, _ = imported(tmp_path / "recording")
    assert report.frames == 2 and not report.skipped and not any("left out" in notice for notice in report.notices)
    assert report.with_depth == 2 * any(what.startswith(("depth", "laser")) for what in files.values())
    assert (report.info.label_set is not None) == any(what.startswith("class") for what in files.values())


def test_the_page_is_that_of_the_layouts() -> None:
    assert LAYOUTS.keys() == FORMATS.keys() and PAGE.read_text(encoding="utf-8") == page(), "-m tools.layouts_page"
