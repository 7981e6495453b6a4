"""A headless Chromium that takes commands over a pipe, from Debian's packages, without root.

The packages are unpacked into ``.tools/chromium`` (100 MB to fetch, 300 MB unpacked) and run from there. WebGL is
rendered by the CPU (SwiftShader). The browser reaches this machine alone: every other name resolves to nothing.
"""

import json
import os
import platform
import select
import subprocess
import sys
import tempfile
import time
from base64 import b64decode
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tools.debian_packages import library_path, unpack_packages

ROOT = Path(__file__).resolve().parents[1]
TREE = ROOT / ".tools" / "chromium"
PROGRAM = TREE / "usr/lib/chromium/chromium-headless-shell"
FLAGS = (
    "--no-sandbox",  # it shows pages of ours alone, and needs no user namespaces then
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    "--remote-debugging-pipe",
)
ANSWER_S = 180.0  # rendering without a GPU on a busy machine


def provide_browser() -> str:
    """Make sure that the browser is there; returns why it cannot be had, empty where it can."""
    if PROGRAM.is_file():
        return ""
    if platform.system() != "Linux":
        return f"this is {platform.system()}"
    return unpack_packages(("chromium-headless-shell", "chromium-common"), TREE, "Chromium")


class Browser:
    """One page of this size in pixels; a context manager."""

    def __init__(self, width: int, height: int) -> None:
        self._size = width, height
        self._next = 0
        self._session = ""
        self._rest = b""
        self.requests: dict[str, str] = {}  # URLs that the page has asked for, by an id
        self.messages: list[str] = []  # what it has said on its console

    def __enter__(self) -> Self:
        self._profile = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        there, self._orders = os.pipe()
        self._answers, here = os.pipe()
        flags = (*FLAGS, f"--user-data-dir={self._profile.name}", f"--window-size={self._size[0]},{self._size[1]}")
        environment = {**os.environ, "LD_LIBRARY_PATH": library_path(TREE), "HOME": self._profile.name}
        program = (str(PROGRAM), *flags)
        # It reads orders from descriptor 3 and answers to 4.
        shell = f'exec 3<&{there} 4>&{here}; exec "$0" "$@"'
        self._process = subprocess.Popen(
            ["/bin/bash", "-c", shell, *program],
            env=environment,
            pass_fds=(there, here),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(there)
        os.close(here)
        target = self._order("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._order("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime"):
            self._order(f"{domain}.enable")
        width, height = self._size
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._order("Emulation.setDeviceMetricsOverride", **metrics)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._orders)
        os.close(self._answers)
        self._profile.cleanup()

    def open(self, url: str) -> None:
        """Go to a page."""
        self._order("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """Value of an expression of JavaScript in the page."""
        return self._order("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def click(self, x: int, y: int) -> None:
        """Press and release the left button at a place of the page."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self._order("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, places: Sequence[tuple[float, float]]) -> None:
        """Press the left button at the first place, move over the others, and release it at the last."""
        self._mouse("mouseMoved", places[0], 0)
        self._mouse("mousePressed", places[0], 1)
        for place in places[1:]:
            self._mouse("mouseMoved", place, 1)
        self._mouse("mouseReleased", places[-1], 0)

    def press(self, *keys: str) -> None:
        """Press and release keys, one after the other, by the names that a page gets ("a", "ArrowUp")."""
        for key in keys:
            text = {"text": key} if len(key) == 1 else {}
            self._order("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
            self._order("Input.dispatchKeyEvent", type="keyUp", key=key)

    def _mouse(self, kind: str, place: tuple[float, float], buttons: int) -> None:
        button = "none" if kind == "mouseMoved" and not buttons else "left"
        where = {"x": place[0], "y": place[1], "button": button, "buttons": buttons}
        self._order("Input.dispatchMouseEvent", type=kind, clickCount=int(kind != "mouseMoved"), **where)

    def picture(self) -> bytes:
        """What is to be seen of the page, as a PNG file."""
        return b64decode(self._order("Page.captureScreenshot", format="png")["data"])

    def wait(self, seconds: float) -> None:
        """Let the page work on, and take in what it says."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._receive(left)

    def _order(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._next += 1
        number = self._next
        order: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session:
            order["sessionId"] = self._session
        os.write(self._orders, json.dumps(order).encode() + b"\0")
        deadline = time.monotonic() + ANSWER_S
        while (left := deadline - time.monotonic()) > 0:
            answer = self._receive(left)
            if answer is not None and answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]
        raise RuntimeError(f"{method}: no answer from the browser for {ANSWER_S:g} s")

    def _receive(self, timeout_s: float) -> dict[str, Any] | None:
        """The next message; events are noted."""
        deadline = time.monotonic() + timeout_s
        while b"\0" not in self._rest:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._answers], [], [], left)[0]:
                return None
            more = os.read(self._answers, 1 << 20)
            if not more:
                raise RuntimeError(f"the browser has ended (exit code {self._process.poll()})")
            self._rest += more
        first, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(first)
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests[message["params"]["requestId"]] = message["params"]["request"]["url"]
            case "Runtime.exceptionThrown":
                details = message["params"]["exceptionDetails"]
                self.messages.append(details.get("exception", {}).get("description", details["text"]))
            case "Runtime.consoleAPICalled":
                words = (str(a.get("value", a.get("description", ""))) for a in message["params"]["args"])
                self.messages.append(" ".join(words))
            case _:
                pass
        return message


if __name__ == "__main__":
    if why := provide_browser():
        sys.exit(f"no browser: {why}")
