"""What people and programs see of the command line: results on stdout, everything else on stderr.

Text is shown as it is: nothing in it is markup, and what would steer the terminal is made visible (``PlainConsole``).
"""

import json
import logging
import os
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

import structlog
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import plain_without_secrets, visible, without_secrets
from semantic_mapper.replay.job_monitor import JobMonitor

_log = structlog.get_logger(__name__)

PIPED_WIDTH = 10_000  # columns of what is no terminal: nothing is wrapped or cut there
LOG_PERIOD_S = 15.0  # how often progress is logged where there is no terminal to draw a bar on


class PlainConsole(Console):
    r"""A console on which every text is plain, wherever it stands: in a line, a cell, a title or next to a bar.

    Names of classes, cameras and files come from logs, maps and weights of others. Markup and emoji codes in them are
    text, and control characters are shown as escapes (``\x1b``), so that no name can end a verb, hide, forge a line or
    command the terminal. Colours are given as ``style``.
    """

    def __init__(self, file: TextIO | None = None, *, stderr: bool = False) -> None:
        super().__init__(file=file, stderr=stderr, markup=False, emoji=False, highlight=False)
        if not self.is_terminal:
            self.width = PIPED_WIDTH

    def render_str(self, text: str, **options: Any) -> Text:
        """Every string that rich is given comes by here, whatever it is part of."""
        plain = {"markup": False, "emoji": False, "highlight": False}
        return super().render_str(visible(without_secrets(text)), **{**options, **plain})

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """And every ``Text``, which may hold line breaks of its own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible(segment.text, keep="\n"))


class Output:
    """Where results go. ``guarded`` keeps stray prints (Open3D prints memory statistics at exit) off stdout."""

    def __init__(self, stream: TextIO) -> None:
        self.console = PlainConsole(stream)
        self.quiet = False  # JSON alone was requested: ``json`` writes it, and ``print`` shows nothing
        self._stream = stream

    @classmethod
    def guarded(cls) -> "Output":
        """Keep the real stdout for results; from now on anything else that is written to it lands on stderr."""
        sys.stdout.flush()
        stream = os.fdopen(os.dup(1), "w", encoding="utf-8")
        os.dup2(2, 1)  # C and C++ code
        sys.stdout = sys.stderr  # Python code
        return cls(stream)

    def print(self, *things: Any) -> None:
        """Show something to people; what is in a text is shown as it is, on one line."""
        if self.quiet:
            return
        if self.console.is_terminal:
            self.console.print(*things, soft_wrap=True)
        else:  # a pipe gets columns, without lines round them or blanks behind them
            for thing in things:
                if isinstance(thing, Table):
                    thing.box, thing.pad_edge, thing.padding = None, False, (0, 2, 0, 0)
            with self.console.capture() as printed:
                self.console.print(*things, soft_wrap=True)
            self._stream.write("\n".join(line.rstrip(" ") for line in printed.get().split("\n")))
        self._stream.flush()

    def lines(self, lines: Sequence[str], most: int = 10) -> None:
        """Show the first of many lines, and how many more there are."""
        for line in lines[:most]:
            self.print(line)
        if len(lines) > most:
            self.print(f"and {len(lines) - most} more")

    def address(self, said: str, url: str) -> None:
        """Show an address of this machine that people are to open, whole; ``print`` hides its parameters."""
        if not self.quiet:
            self._stream.write(f"{said} {url}\n")
            self._stream.flush()

    def json(self, data: Any) -> None:
        """Write one JSON document where it was requested, without secrets of the addresses in it."""
        if self.quiet:
            self._stream.write(json.dumps(plain_without_secrets(data), indent=1, allow_nan=False) + "\n")
            self._stream.flush()


def table(
    rows: Iterable[Sequence[object]],
    names: Sequence[str] = (),
    *,
    title: str = "",
    caption: str = "",
    numbers: Collection[str] = (),
) -> Table:
    """A table for ``Output.print``, of cells (None is an empty one), names of the columns (without any the first column
    names the rows), and which of these are of ``numbers``, that end at the right. Empty named columns are left out."""
    found = Table(title=title, caption=caption, title_justify="left", show_header=bool(names), box=SIMPLE_HEAD)
    found.show_edge, found.pad_edge, found.padding = False, False, (0, 1, 0, 0)
    cells = [["" if cell is None else cell if isinstance(cell, Text) else str(cell) for cell in row] for row in rows]
    shown = [not cells or any(row[i] for row in cells) for i in range(max(len(names), *map(len, cells), 0))]
    for name, is_shown in zip(names, shown, strict=False):
        if is_shown:
            found.add_column(name, justify="right" if name in numbers else "left", overflow="fold")
    for row in cells:
        found.add_row(*(cell for cell, is_shown in zip(row, shown, strict=True) if is_shown or not names))
    return found


def stderr_console() -> PlainConsole:
    """For messages and progress."""
    return PlainConsole(stderr=True)


class FrameProgress(JobMonitor):
    """A bar with frames a second and time left; events in the log where stderr is no terminal."""

    def __init__(self, progress: Progress, what: str, total: int | None, unit: str, stop: StopRequest | None) -> None:
        self._progress = progress
        self._task = progress.add_task(what, total=total, note="", rate="")
        self._what, self._stage, self._total, self._unit = what, "", total, unit
        self._stop = stop
        self._done = 0
        self._began = self._reported = time.monotonic()

    @property
    def stopped_by(self) -> str:
        """The signal that asks for an early end; empty = none has come."""
        return self._stop.name if self._stop is not None else ""

    def start(self, total: int | None, stage: str = "") -> None:
        """Now it is known how many there are, and work begins, or a stage of it with a name of its own."""
        self._total, self._stage = total, stage
        self._began = self._reported = time.monotonic()
        self._progress.reset(self._task, total=total, description=stage or self._what, rate="", note="")
        if stage and not self._progress.console.is_terminal:
            _log.info(stage, total=total)

    def report(self, stage: str, done: int, total: int) -> None:
        """So many of a stage, or of all (""), are done; a new stage begins a new bar."""
        if (stage, total) != (self._stage, self._total):
            self.start(total, stage)
        self.set(done)

    def advance(self, count: int = 1) -> None:
        """This many more are done."""
        self.set(self._done + count)

    def set(self, done: int, note: str = "") -> None:
        """This many are done by now; ``note`` replaces the text next to the bar."""
        self._done = done
        now = time.monotonic()
        rate = f"{done / max(now - self._began, 1e-9):.2f} {self._unit}/s"
        more: dict[str, Any] = ({} if self._stage else {"rate": rate}) | ({"note": note} if note else {})
        self._progress.update(self._task, completed=done, **more)
        if not self._progress.console.is_terminal and now - self._reported >= LOG_PERIOD_S:
            self._reported = now
            _log.info(self._stage or self._what, done=done, total=self._total, **more)


@contextmanager
def frame_progress(
    what: str, total: int | None, unit: str = "frames", stop: StopRequest | None = None
) -> Iterator[FrameProgress]:
    """Show progress while inside; ``total`` None where nobody knows it. ``stop`` is what ends the job early."""
    columns = (
        TextColumn("{task.description}", "bold", markup=False),
        BarColumn(20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}", "cyan", markup=False),
        TextColumn("left"),
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[note]}", markup=False),
    )
    console, log = stderr_console(), structlog.get_config()
    if console.is_terminal and not _log.is_enabled_for(logging.DEBUG):  # the bar tells it; warnings stand above it
        structlog.configure(**{**log, "wrapper_class": structlog.make_filtering_bound_logger("warning")})
    try:
        with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
            yield FrameProgress(progress, what, total, unit, stop)
    finally:
        if console.is_terminal:
            structlog.configure(**log)
