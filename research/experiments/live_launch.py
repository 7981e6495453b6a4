"""A live launch that is watched from outside: what it tells, what its nodes publish, what it records."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from semantic_mapper.errors import LogError
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.transport.codec import decode_as, read_envelope
from semantic_mapper.transport.messages import TOPICS, Status
from semantic_mapper.transport.sockets import LosslessSubscriber
from semantic_mapper.types import MapUpdate

COMMAND = Path(sys.executable).parent / "semantic-mapper"
LAUNCH_FOLDER = Path(__file__).resolve().parents[2] / "launch"
NODES = ("camera", "recorder", "mapper")  # of camera.toml
PATIENCE_S = 600.0

Key = tuple[str, str, int, int]  # topic, source, stamp, number


class Told:
    """A process's stderr, each line with the time when it came."""

    def __init__(self, stream: IO[str]) -> None:
        self._lines: list[tuple[float, str]] = []
        self._grown = threading.Condition()
        self._ended = False
        threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def wait(self, pattern: str, after_s: float = 0.0) -> tuple[float, str]:
        """The first line that matches and came later than that."""

        def found() -> tuple[float, str] | None:
            return next((line for line in self._lines if line[0] > after_s and re.search(pattern, line[1])), None)

        with self._grown:
            line = self._grown.wait_for(lambda: found() or self._ended, PATIENCE_S) and found()
        if not line:
            raise SystemExit(f"no line matches {pattern!r} in:\n" + "\n".join(text for _, text in self._lines[-80:]))
        return line

    def last(self, pattern: str, before_s: float = float("inf")) -> tuple[float, re.Match[str]] | None:
        """The last line that matches and came before that."""
        for at, text in reversed(self._lines):
            if at < before_s and (found := re.search(pattern, text)):
                return at, found
        return None

    def all(self, pattern: str) -> list[str]:
        """What the pattern's group holds, of all lines so far."""
        return [found[1] for _, text in self._lines if (found := re.search(pattern, text))]

    def _read(self, stream: IO[str]) -> None:
        for text in stream:
            with self._grown:
                self._lines.append((time.monotonic(), text.rstrip("\n")))
                self._grown.notify_all()
        with self._grown:
            self._ended = True
            self._grown.notify_all()


class Heard:
    """Messages of one node, with the time when they came."""

    def __init__(self, endpoint: str, topics: Iterable[str]) -> None:
        self.came: list[tuple[float, Key]] = []
        self.counters: dict[str, int] = {}  # of the node's last status
        self.worked_s: dict[int, float] = {}  # by the number of a frame: what mapping it took
        self._subscriber = LosslessSubscriber(endpoint, tuple(topics))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._hear, daemon=True)
        self._thread.start()

    def numbers(self, topic: str) -> list[tuple[float, int]]:
        """When messages of a topic came, and their numbers."""
        return [(at, key[3]) for at, key in list(self.came) if key[0] == topic]

    def first_after(self, topic: str, after_s: float) -> tuple[float, int]:
        """When the first one after that came, and how many numbers lie between it and the last one before."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            numbers = self.numbers(topic)
            after = next(((at, seq) for at, seq in numbers if at > after_s), None)
            if after is not None:
                before = [seq for at, seq in numbers if at <= after_s]
                return after[0], max(0, after[1] - before[-1] - 1)
            time.sleep(0.01)
        raise SystemExit(f"no '{topic}' came within {PATIENCE_S:g} s after a fault")

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()
        self._subscriber.close()

    def _hear(self) -> None:
        while not self._ended.is_set():
            parts = self._subscriber.receive_parts(0.1)
            if parts is not None:
                now, e = time.monotonic(), read_envelope(parts)
                self.came.append((now, (e.topic, e.source, e.stamp_ns, e.seq)))
                if e.topic == "status":
                    self.counters = dict(decode_as(Status, parts).counters)
                if e.topic == "map":
                    self.worked_s[e.seq] = sum(decode_as(MapUpdate, parts).stage_ms.values()) / 1000


class LiveLaunch:
    """``semantic-mapper up`` of a launch file in the background. A context manager that leaves no process.

    Args:
        settings: NAME=VALUE, as of ``up``.
        out: Folder for its results.
        variables: Added to its environment.
        name: Of the launch file, which is used as it ships.
        nodes: That it has.
    """

    def __init__(
        self,
        settings: Iterable[str],
        out: Path,
        variables: Mapping[str, str] | None = None,
        name: str = "camera.toml",
        nodes: Sequence[str] = NODES,
    ) -> None:
        out.mkdir(parents=True, exist_ok=True)
        more = ["recorder.enabled=true"] if "recorder" in nodes else []
        chosen = [word for setting in (*settings, *more) for word in ("--set", setting)]
        self.out = out
        self.nodes = tuple(nodes)
        self.process = subprocess.Popen(
            [str(COMMAND), "up", str(LAUNCH_FOLDER / name), *chosen, "--out", str(out)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(variables or {})},
        )
        assert self.process.stderr is not None
        self.told = Told(self.process.stderr)
        self.camera: Heard | None = None
        self.mapper: Heard | None = None
        self.recorder: Heard | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for heard in (self.camera, self.mapper, self.recorder):
            if heard is not None:
                heard.close()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def sockets(self) -> str:
        """Folder of its sockets, once all nodes are ready."""
        self.told.wait("all_ready")
        return re.split(r"sockets=", self.told.wait("sockets=")[1])[1].split()[0]

    def listen(self) -> tuple[Heard, Heard]:
        """Hear camera and mapper, from when all are ready."""
        folder = self.sockets()
        self.camera = Heard(f"ipc://{folder}/camera", ("frame",))
        self.mapper = Heard(f"ipc://{folder}/mapper", ("map", "refused", "status"))
        if "recorder" in self.nodes:
            self.recorder = Heard(f"ipc://{folder}/recorder", ("status",))
        return self.camera, self.mapper

    def pids(self) -> dict[str, int]:
        """Of the nodes that are at work."""
        return {node: int(self.told.all(rf"node_started .*node={node} pid=(\d+)")[-1]) for node in self.nodes}

    def all_pids(self) -> list[int]:
        """Of every process that ever was."""
        return [int(pid) for pid in self.told.all(r"node_started .*pid=(\d+)")]

    def logged(self) -> set[Key]:
        """All messages that can be read in its logs."""
        found: set[Key] = set()
        for path in sorted(self.out.glob("recorded*.mcap")):
            try:
                with LogReader(path, allow_empty=True) as log:
                    found |= {(e.topic, e.source, e.stamp_ns, e.seq) for e, _ in log.messages()}
            except LogError:  # cut off before its first message
                continue
        return found

    def not_logged(self, began_s: float, ended_s: float, logged: set[Key]) -> int:
        """Messages that were heard in this time, belong into the log, and are in none."""
        assert self.camera is not None and self.mapper is not None
        came = [key for heard in (self.camera, self.mapper) for at, key in heard.came if began_s <= at < ended_s]
        return sum(TOPICS[key[0]].logged and key not in logged for key in came)


def is_alive(pid: int) -> bool:
    """Runs still, and is no zombie that nobody has waited for yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
