"""The mapper node's own decisions; whole runs are in test_up.py."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import structlog.testing

from semantic_mapper.errors import MapError
from semantic_mapper.nodes.mapper.autosave import Autosave
from semantic_mapper.nodes.mapper.node import _Mapper
from tests.mapping.rendered_views import small_map
from tests.mapping.storage.test_paging import walk
from tests.nodes.mapper.test_resume import context
from tests.nodes.support import eventually


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


class _Corrected(_Mapper):
    def __init__(self, notes: Path, autosave: Autosave) -> None:
        """No sockets: only what follows a first corrected pose is looked at."""
        pipeline = SimpleNamespace(corrector=SimpleNamespace(status=SimpleNamespace(poses=3)))
        self._bundle: Any = SimpleNamespace(pipeline=pipeline)
        self._context = context(notes, 0)
        self._autosave = autosave
        self._corrected = False


@pytest.mark.parametrize("room", [True, False])
def test_a_correction_that_cannot_be_noted_ends_the_saving_and_not_the_mapper(tmp_path: Path, room: bool) -> None:
    voxel_map, path = small_map(voxel_size_m=0.02), tmp_path / "map.npz"
    autosave = Autosave(voxel_map, path, 1e-9)
    walk(voxel_map, 1)
    mapper = _Corrected(tmp_path / "notes", autosave)
    if not room:
        (tmp_path / "notes").rmdir()
    mapper._note_correction()
    mapper._note_correction()
    autosave.follow()
    if room:
        assert eventually(lambda: autosave.saves == 1) and not autosave.failure
    else:
        assert autosave._thread is None and not path.exists() and "no note could say so" in autosave.failure
