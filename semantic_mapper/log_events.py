"""Events of the library: through structlog where the program has set it up, else through Python's ``logging``.

A library leaves stdout to its program. structlog that nobody has set up prints there; ``logging`` that nobody has set
up writes warnings to stderr and is silent otherwise. A program that calls ``structlog.configure``, at any time, gets
the events as structlog's; nothing here changes that configuration.
"""

import logging
from typing import Any

import structlog

_PROCESSORS: tuple[Any, ...] = (
    structlog.contextvars.merge_contextvars,
    structlog.stdlib.filter_by_level,
    structlog.processors.format_exc_info,
    structlog.dev.ConsoleRenderer(colors=False, pad_event_to=0),
)


def get_logger(name: str) -> Any:
    """As ``structlog.get_logger``; ``name`` is that of the module, and of its logger in ``logging``."""
    return _Logger(name)


def is_power_of_two(count: int) -> bool:
    """Whether to log what has now happened ``count`` times, so that what happens all the time fills no log."""
    return count & (count - 1) == 0


class _Logger:
    """Decides at each event: programs may set up structlog after they have imported us."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, method: str) -> Any:
        if structlog.is_configured():
            return getattr(structlog.get_logger(self._name), method)
        standard = logging.getLogger(self._name)
        return getattr(
            structlog.wrap_logger(standard, processors=_PROCESSORS, wrapper_class=structlog.stdlib.BoundLogger), method
        )
