"""What every process of ours does first: thread counts, logging, and how it is requested to stop.

Imports nothing heavy: thread counts must be in the environment before torch or Open3D are loaded.
"""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any, Self

import structlog

from semantic_mapper.memory import is_out_of_memory, memory_message
from semantic_mapper.plain_text import visible, without_secrets

STOP_SIGNAL = signal.SIGUSR1  # by which a launcher asks its nodes to end: SIGTERM may come from anybody
EXIT_LOSS = 3  # of a node that came to its end in order, but a part of what it was to keep is lost
FAILURE_EVENT, LOSS_EVENT = "node_failed", "node_lost_data"  # log events with a node's last words
JOB_PREFIX = "fd:"  # of a node's argument that names an open file with its job
MAX_THREADS = 16  # more gain nothing on the small work of one frame


def prepare_process(*, verbose: bool = False) -> None:
    """Set thread counts (kept where the user has set them) and send log events to stderr, one a line.

    The command line and the nodes compute with the same number of threads, so that their maps are equal bit for bit.
    """
    os.environ.setdefault("OMP_NUM_THREADS", str(min(usable_cores(), MAX_THREADS)))
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")  # s; a camera that has stalled hangs OpenCV for 10
    if not verbose:  # damaged films: FFmpeg's own lines; what is wrong is said in an error or a note of ours
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            structlog.processors.format_exc_info,
            _one_line,
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=24),
        ],
        wrapper_class=structlog.make_filtering_bound_logger("debug" if verbose else "info"),
        logger_factory=lambda *_: structlog.PrintLogger(_Stderr()),  # pyright: ignore[reportArgumentType]
    )


def usable_cores() -> int:
    """Cores that this process may really use: affinity, and the CPU quota of its control group (a container's)."""
    cores = len(os.sched_getaffinity(0))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
    except (OSError, ValueError):  # no control group of version 2: no quota that we know of
        return cores
    return cores if quota == "max" else max(1, min(cores, round(int(quota) / int(period))))


def run_when_idle() -> None:
    """Let the calling thread, and those that it starts, compute only while nobody else wants the core; others go on."""
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except (AttributeError, OSError) as error:  # not Linux, or forbidden
        niceness = os.getpriority(os.PRIO_PROCESS, 0)
        structlog.get_logger(__name__).info("no_idle_scheduling", reason=str(error), niceness=niceness)


def failure_message(error: BaseException) -> str:
    """What a failure that is no error of ours says to people, on one line: out of memory, an error of the system, or
    PyTorch, of which mapping has no need. Empty where it is a bug, whose traceback is worth more."""
    if is_out_of_memory(error):  # native packages raise whatever they like then
        return memory_message(error)
    if isinstance(error, OSError):  # disk full, permission denied: the system's own words and the file
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if isinstance(error, ModuleNotFoundError) and error.name == "torch":
        return "this needs PyTorch, which is not installed: pip install torch, or here .tools/bin/uv pip install torch"
    return ""


class StopRequest:
    """SIGINT and SIGTERM as a request: while it is entered, the first one is only noted.

    Where it is ``patient``, further signals change nothing (nodes: the launcher kills what does not end); else the
    second one raises ``KeyboardInterrupt`` (a person has pressed Ctrl-C twice).
    """

    def __init__(
        self, *, patient: bool = False, signals: tuple[signal.Signals, ...] = (signal.SIGINT, signal.SIGTERM)
    ) -> None:
        self.signum = 0
        self._patient = patient
        self._signals = signals
        self._previous: dict[int, Any] = {}

    def __bool__(self) -> bool:
        return self.signum != 0

    @property
    def name(self) -> str:
        """Who requested the stop: SIGINT, SIGTERM, the launcher, or empty."""
        if self.signum == STOP_SIGNAL:
            return "the launcher"
        return signal.Signals(self.signum).name if self.signum else ""

    @property
    def exit_code(self) -> int:
        """What shells expect of a process that a signal has ended: 128 + its number; 0 for none and the launcher's."""
        return 128 + self.signum if self.signum not in (0, STOP_SIGNAL) else 0

    def __enter__(self) -> Self:
        for signum in self._signals:
            self._previous[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._previous.items():
            if signal.getsignal(signum) == self._note:  # else somebody has set another one meanwhile
                signal.signal(signum, handler)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if self.signum and not self._patient:
            raise KeyboardInterrupt
        self.signum = self.signum or signum


class _Stderr:
    """The current ``sys.stderr`` (progress bars exchange it); what nobody reads any more is no reason to die."""

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError):  # the reader of the pipe is gone, or the stream is closed at exit
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.flush()


def _one_line(logger: Any, method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    """Keep one event on one line, the terminal as it is, and secrets out, whatever a message says."""

    def shown(value: object, key: str) -> str:
        text = without_secrets(str(value))
        return visible(text, keep="\n") if key == "exception" else visible(text.replace("\n", " | "))

    return {k: v if isinstance(v, bool | int | float | None) else shown(v, k) for k, v in event.items()}
