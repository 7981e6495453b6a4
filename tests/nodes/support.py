"""Real processes for tests: tiny logs and weights, the installed command, and what it leaves running."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import typer
from typer.testing import CliRunner

from semantic_mapper.config import GridFieldConfig
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.nodes.cli import main as cli
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.launcher.liveness import HeartbeatWriter
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.training.config import GridFitConfig
from semantic_mapper.training.grid_fit import grid_of_depth
from semantic_mapper.training.scene_box import scene_box
from semantic_mapper.training.views import frame_rays
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame
from tests.small import INTRINSICS, tiny_field, tiny_frames

COMMAND = Path(sys.executable).parent / "semantic-mapper"
REPLAY_LAUNCH = Path(__file__).resolve().parents[2] / "launch" / "replay.toml"
TIMEOUT_S = 300.0  # a command may compile kernels on a busy machine
CONFIG = """
[render]
encode_width = 96
scale = 0.25
[keyframes]
source_views = 3
[sampling]
guided = 4
[voxel_map]
voxel_size_m = 0.05
unknown_below = 0.0
"""


def write_log(path: Path, frames: Sequence[PosedFrame], label_set: LabelSet = ROOMS) -> Path:
    info = StreamInfo(source="test room", cameras={"rooms": INTRINSICS}, label_set=label_set, frame_count=len(frames))
    with LogWriter(path, info) as log:
        for frame in frames:
            log.write_frame(frame)
    return path


def repeated_frames(count: int) -> list[PosedFrame]:
    """Many frames at the price of a few: the same ones again, with new numbers and stamps."""
    few = tiny_frames(4)
    return [dataclasses.replace(few[i % 4], seq=i, stamp_ns=(i + 1) * 66_666_667) for i in range(count)]


def write_weights(path: Path, train_stamps_ns: Sequence[int] = ()) -> Path:
    recipe = {"kind": "test", "width": 96, "train_stamps_ns": list(train_stamps_ns)}
    save_checkpoint(Checkpoint(tiny_field(), (), recipe), path)
    return path


def write_grid(path: Path) -> Path:
    """A scene grid of the depth of ``tiny_frames``."""
    grid = grid_of_depth(frame_rays(tiny_frames(6), 96), scene_box(tiny_frames(6), GridFitConfig()))
    field = GridField(GridFieldConfig(grid=grid.config), ROOMS)
    field.grid.load_state_dict(grid.state_dict())
    field.fitted_steps += 1
    save_checkpoint(Checkpoint(field, (), {"width": 96}), path)
    return path


def write_config(path: Path) -> Path:
    path.write_text(CONFIG, encoding="utf-8")
    return path


def free_port() -> int:
    """Of loopback; nobody holds it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def run(*arguments: str | Path, app: typer.Typer = cli.app) -> subprocess.CompletedProcess[str]:
    """The command in this process, which is quicker, to its end."""
    words, stdout = [str(a) for a in arguments], io.StringIO()
    with patch.object(Output, "guarded", lambda: Output(stdout)):
        done = CliRunner().invoke(app, words)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return subprocess.CompletedProcess(words, done.exit_code, stdout.getvalue() + done.stdout, done.stderr)


def run_process(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The installed command, in a process of its own."""
    return subprocess.run(
        [str(COMMAND), *map(str, arguments)], capture_output=True, text=True, timeout=TIMEOUT_S, check=False, cwd=cwd
    )


def run_ok(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """As ``run``, of what must end well."""
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    return done


def refused(*arguments: str | Path, code: int = 1) -> str:
    """As ``run``, of what must fail: its line of error, or all of what it says about wrong usage."""
    done = run(*arguments)
    assert done.returncode == code, done.stdout + done.stderr
    return " ".join((done.stderr if code == 2 and "Usage:" in done.stderr else error_line(done.stderr)).split())


def launch_settings(log: Path, weights: Path, config: Path, *more: str) -> list[str]:
    """Words for ``up``: a log for its camera, and what its mapper maps with."""
    given = (f"camera.log={log}", f"mapper.weights={weights}", f"mapper.config={config}", *more)
    return [word for setting in given for word in ("--set", setting)]


def summary_of(out: Path) -> dict[str, Any]:
    """What a run says of itself."""
    return json.loads((out / "summary.json").read_text())


@dataclass
class NodeHere:
    """A node in a thread of this process."""

    thread: threading.Thread
    stop: StopRequest
    error: Exception | None = None  # that it ended with

    def wait(self, timeout_s: float = 100.0) -> None:
        """Until it ends by itself."""
        self.thread.join(timeout_s)
        assert not self.thread.is_alive()


@contextmanager
def node_here(
    work: Callable[[NodeContext, Any], object],
    name: str,
    endpoints: dict[str, str],
    options: Any,
    *,
    beats: int = -1,
    fails: bool = False,
    **more: Any,
) -> Iterator[NodeHere]:
    """A node; it is asked to stop at the end. An error is that of the test unless the node may fail."""
    stop = StopRequest(patient=True)
    context = NodeContext(name, endpoints, 1, stop, HeartbeatWriter(beats, 1), **more)

    def run() -> None:
        try:
            work(context, options)
        except Exception as error:  # noqa: BLE001 - of any kind
            node.error = error

    node = NodeHere(threading.Thread(target=run, daemon=True), stop)
    node.thread.start()
    try:
        yield node
    finally:
        stop.signum = 15
        node.wait(60)
    if node.error is not None and not fails:
        raise node.error


class Running:
    """The command in the background; its stderr is read line by line."""

    def __init__(self, *arguments: str | Path, command: Path = COMMAND) -> None:
        self.process = subprocess.Popen(
            [str(command), *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.lines: list[str] = []
        self._ended = False
        self._grown = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *exception: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        for pid in self.node_pids():
            if is_alive(pid):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def wait_for_line(self, pattern: str) -> str:
        """The first line of stderr that matches."""

        def found() -> str | None:
            return next((line for line in self.lines if re.search(pattern, line)), None)

        with self._grown:
            line = self._grown.wait_for(lambda: found() or self._ended, TIMEOUT_S) and found()
        assert line, f"no line matches {pattern!r} in:\n{self.text}"
        return str(line)

    def wait(self) -> int:
        code = self.process.wait(TIMEOUT_S)
        self._reader.join(10)
        return code

    def sockets(self) -> Path:
        return Path(self.wait_for_line(r"sockets=").split("sockets=")[1].split()[0])

    def node_pids(self) -> list[int]:
        return [int(n) for line in self.lines for n in re.findall(r"node_started.*pid=(\d+)", line)]

    def node_pid(self, name: str) -> int:
        line = self.wait_for_line(rf"node_started.*node={name}\b")
        return int(re.findall(r"pid=(\d+)", line)[0])

    def _read(self) -> None:
        for line in self.process.stderr:
            with self._grown:
                self.lines.append(line.rstrip("\n"))
                self._grown.notify_all()
        with self._grown:
            self._ended = True
            self._grown.notify_all()


def addresses_listening(port: int) -> set[str]:
    """On which somebody listens to a port, as the kernel writes them."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:] + Path("/proc/net/tcp6").read_text().splitlines()[1:]
    sockets = (line.split() for line in lines)
    return {s[1].split(":")[0] for s in sockets if s[3] == "0A" and int(s[1].split(":")[1], 16) == port}


def is_alive(pid: int) -> bool:
    """Runs still, and is no zombie that nobody has waited for yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def eventually(holds: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> bool:
    """Whether it comes to hold."""
    deadline = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def error_line(stderr: str) -> str:
    """The one line that says what went wrong."""
    assert "Traceback" not in stderr, stderr
    lines = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, stderr
    return lines[0]
