"""The labelling page in a headless browser: strokes of mouse, keys and finger become label images."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.labeller.server import LabelServer, LabelSession
from semantic_mapper.replay.label_folder import make_label_folder
from semantic_mapper.replay.log.sequence import open_log
from tests.browser import PROGRAM, Browser

pytestmark = pytest.mark.skipif(
    not PROGRAM.is_file(), reason="no browser in .tools/chromium; `make test-web` fetches one and runs these tests"
)
HEIGHT, WIDTH = 72, 96
WALL, FLOOR, CEILING = (ROOMS.id_of(name) for name in ("wall", "floor", "ceiling"))
WAIT_S = 60.0


class Page(NamedTuple):
    browser: Browser
    url: str
    out: Path

    def eventually(self, holds: Callable[[], bool]) -> bool:
        for _ in range(int(WAIT_S / 0.2)):
            if holds():
                return True
            self.browser.wait(0.2)
        return False

    def saved(self, frame: int, holds: Callable[[np.ndarray[Any, Any]], bool]) -> bool:
        """Whether the label image of a frame comes to be as it should."""
        file = self.out / f"{frame:06d}.png"

        def there() -> bool:
            return file.exists() and holds(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))

        return self.eventually(there) and self.status("saved")

    def status(self, text: str) -> bool:
        return self.eventually(lambda: self.browser.evaluate("document.getElementById('status').textContent") == text)

    def open(self) -> None:
        self.browser.open(self.url)
        assert self.eventually(
            lambda: self.browser.evaluate("!!document.querySelector('[role=radio]') && !!sheet.style.width") is True
        )

    def on(self, *pixels: tuple[float, float]) -> list[tuple[float, float]]:
        """Places of the page that show pixels of the frame."""
        box = self.browser.evaluate(
            "(({left, top, width, height}) => [left, top, width, height])"
            "(document.getElementById('sheet').getBoundingClientRect())"
        )
        return [(box[0] + (x + 0.5) * box[2] / WIDTH, box[1] + (y + 0.5) * box[3] / HEIGHT) for x, y in pixels]

    def shown(self, x: int, y: int) -> list[int]:
        script = f"[...document.getElementById('paint').getContext('2d').getImageData({x}, {y}, 1, 1).data]"
        return self.browser.evaluate(script)


@pytest.fixture
def page(log: Path, tmp_path: Path) -> Iterator[Page]:
    out = tmp_path / "labels"
    with open_log(log) as opened:
        folder = make_label_folder(out, opened, ROOMS)
        session = LabelSession(opened, folder, [4, 1])
        with LabelServer(session, 0) as server, Browser(1100, 700) as browser:
            page = Page(browser, server.url, out)
            page.open()
            assert page.status("nothing painted yet")
            yield page
            assert browser.messages == []
            assert {urlsplit(url).hostname for url in browser.requests.values()} == {"127.0.0.1"}


def test_strokes_of_the_mouse_are_saved_at_once_and_can_be_undone_and_erased(page: Page) -> None:
    page.browser.press("2")
    page.browser.drag(page.on((10, 50), (30, 50), (80, 50)))
    assert page.saved(4, lambda label: bool((label[50, 10:81] == FLOOR).all()))
    page.browser.press("1")
    page.browser.drag(page.on((10, 10), (80, 12)))
    assert page.saved(4, lambda label: bool(label[10, 10] == WALL and label[12, 80] == WALL and label[50, 40] == FLOOR))
    page.browser.press("z")
    assert page.saved(4, lambda label: not (label == WALL).any() and bool(label[50, 40] == FLOOR))

    page.browser.press("e")
    page.browser.drag(page.on((40, 40), (40, 60)))
    assert page.saved(4, lambda label: bool(label[50, 40] == ROOMS.ignore_id and label[50, 20] == FLOOR))
    page.browser.press("z", "z")
    assert page.eventually(lambda: not (page.out / "000004.png").exists()), "nothing is painted any more"


def test_what_was_saved_is_there_again_and_a_click_is_a_dot(page: Page) -> None:
    page.browser.press("3", "]", "]", "]")
    page.browser.click(*page.on((48, 30))[0])
    assert page.saved(4, lambda label: bool(label[30, 48] == CEILING and (label == CEILING).sum() > 4))
    page.browser.press("n")
    assert page.status("nothing painted yet") and page.shown(48, 30)[3] == 0
    page.browser.drag(page.on((5, 5), (90, 5)))
    assert page.saved(1, lambda label: bool((label[5, 5:91] == CEILING).all()))
    page.open()
    assert page.eventually(lambda: "2 labelled" in page.browser.evaluate("place.textContent"))
    assert page.eventually(lambda: page.shown(48, 30) == [*ROOMS.colors[CEILING - 1], 255])


def test_all_of_it_can_be_done_with_keys_alone(page: Page) -> None:
    page.browser.evaluate("document.getElementById('stage').focus()")
    page.browser.press("2", " ")
    assert page.saved(4, lambda label: bool(label[HEIGHT // 2, WIDTH // 2] == FLOOR and label[36, 70] == 0))
    page.browser.press("Enter", *["ArrowRight"] * 20, "Enter", "ArrowDown")
    assert page.saved(4, lambda label: bool((label[36, 48:64] == FLOOR).all()))
    page.browser.press("PageDown")
    assert page.status("nothing painted yet")
    assert page.browser.evaluate("document.getElementById('number').value") == "1"
    unnamed = "[...document.querySelectorAll('button, input')].filter(e => !(e.textContent || e.labels?.length)).length"
    assert page.browser.evaluate(unnamed) == 0, "each control has a name"


def test_a_stroke_that_cannot_be_saved_is_said_kept_and_saved_later(page: Page) -> None:
    labels = (page.out / "labels.json").read_bytes()
    moved = page.out.rename(page.out.with_name("away"))
    page.browser.press("2")
    page.browser.drag(page.on((10, 50), (80, 50)))
    status = "document.getElementById('status').textContent"
    assert page.eventually(lambda: str(page.browser.evaluate(status)).startswith("not saved: "))
    assert page.shown(40, 50)[3] == 255
    hidden = "document.getElementById('again').hidden"  # it is while the page tries by itself
    assert page.eventually(lambda: page.browser.evaluate(hidden) is False)
    moved.rename(page.out)
    assert page.saved(4, lambda label: bool((label[50, 10:81] == FLOOR).all()))
    assert (page.out / "labels.json").read_bytes() == labels
