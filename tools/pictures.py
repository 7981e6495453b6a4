"""Make the pictures of README from the recorded room: ``python -m tools.pictures``.

No real recording at hand may be shown: redkitchen is for research alone. The browser is that of the tests of pages.
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path

from semantic_mapper.nodes.process import prepare_process
from semantic_mapper.nodes.viewer.server import WebViewer
from semantic_mapper.nodes.viewer.sources import WatchedSession
from semantic_mapper.replay.artifacts import OVERVIEW_NAME
from semantic_mapper.replay.log import demo_log
from semantic_mapper.replay.map_log import replay_log
from semantic_mapper.replay.rerun_log import recording_server
from tests.browser import Browser, provide_browser

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
SIZE = 1280, 800
LOOK_S, LOOKS = 5.0, 60  # between two looks at the page, until it is as it was at the last one


def main() -> None:
    """Write docs/images/demo.png and viewer.png."""
    prepare_process()
    if why := provide_browser():
        sys.exit(f"no browser: {why}")
    with tempfile.TemporaryDirectory() as folder, WebViewer(0) as viewer:
        replay_log(demo_log(), Path(folder), watch=partial(WatchedSession, lambda: recording_server(viewer.data_url)))
        (IMAGES / "demo.png").write_bytes((Path(folder) / OVERVIEW_NAME).read_bytes())
        with Browser(*SIZE) as browser:
            browser.open(viewer.page_url)
            browser.wait(4 * LOOK_S)  # it loads, and then draws nothing for a while
            before = b""
            for _ in range(LOOKS):
                browser.wait(LOOK_S)
                picture = browser.picture()
                if picture == before:
                    break
                before = picture
        (IMAGES / "viewer.png").write_bytes(before)


if __name__ == "__main__":
    main()
