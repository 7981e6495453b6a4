"""The mapper node's own decisions; whole runs are in test_up.py."""

from __future__ import annotations

from typing import Any

import structlog.testing

from nodes.mapper import _Mapper
from semantic_mapper.errors import MapError


class _FullDisk(_Mapper):
    def __init__(self) -> None:
        """No sockets: only what follows a failure is looked at."""

    def finish(self) -> None:
        raise MapError("map.npz: no space left")


def test_a_failure_to_write_does_not_hide_what_ended_the_run() -> None:
    with structlog.testing.capture_logs() as logs:
        _FullDisk().finish_after(MapError("the map is full"))
    told: list[Any] = [e for e in logs if e["event"] == "results_not_written"]
    assert told and told[0]["reason"] == "map.npz: no space left" and told[0]["after"] == "the map is full"
