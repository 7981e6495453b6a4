"""Work in a thread that takes no more than its share of a core, and that can be given up at any time."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import structlog

LEAST_REST_S = 0.02  # shorter rests are saved up

_log = structlog.get_logger(__name__)


def run_when_idle() -> None:
    """Let the calling thread, and those that it starts, compute only while nobody else wants the core.

    Niceness 19 weighs 15 where others weigh 1024, SCHED_IDLE 3, and it gives way at once to whoever wakes up. Other
    threads stay as they are, so that messages are still answered while learning gets nothing.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except (AttributeError, OSError) as error:  # not Linux, or forbidden
        _log.info("no_idle_scheduling", reason=str(error), niceness=os.getpriority(os.PRIO_PROCESS, 0))


def run_again(thread: threading.Thread) -> None:
    """Undo ``run_when_idle`` for a thread, so that it comes to its end on a busy machine, too.

    Linux lets root do so, and whoever has an RLIMIT_NICE that allows its niceness; else it stays as it is.
    """
    if thread.native_id is None or not thread.is_alive():
        return
    try:
        os.sched_setscheduler(thread.native_id, os.SCHED_OTHER, os.sched_param(0))
    except (AttributeError, OSError) as error:
        _log.info("stays_idle", reason=str(error), thread=thread.name)


class AbandonedError(Exception):
    """Nobody wants the outcome any more; raised in the middle of the work, to end it."""


class Throttle:
    """Makes the work rest after each layer of a network, for as long as its share says.

    No credit is given for rests that were longer than they had to be.

    Args:
        share: Of the time that ``clock`` measures, in 0..1.
        clock: Of what the work costs, seconds: CPU time of the process, or, where a GPU does the work, any clock.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.process_time) -> None:
        self._share = share
        self._clock = clock
        self._since = clock()
        self._abandoned = threading.Event()
        self.rested_s = 0.0

    def abandon(self) -> None:
        """Make the work end with ``AbandonedError``; for any thread."""
        self._abandoned.set()

    def rest(self) -> None:
        """Rest if it is time to; for the thread that works.

        Raises:
            AbandonedError: it is to end.
        """
        spent = self._clock() - self._since
        rest_s = spent / self._share - spent
        if rest_s >= LEAST_REST_S:
            began = time.monotonic()
            self._abandoned.wait(rest_s)
            self.rested_s += time.monotonic() - began
            self._since = self._clock()
        if self._abandoned.is_set():
            raise AbandonedError

    @contextmanager
    def pacing(self) -> Iterator[None]:
        """Within this, each network that the calling thread runs rests before each of its layers."""
        from torch.nn.modules.module import register_module_forward_pre_hook

        worker = threading.get_ident()

        def before_layer(module: Any, inputs: Any) -> None:
            if threading.get_ident() == worker:
                self.rest()

        self._since = self._clock()
        hook = register_module_forward_pre_hook(before_layer)
        try:
            yield
        finally:
            hook.remove()
