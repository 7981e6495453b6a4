"""Arms over scenes, of which each scores many views: making the records that are missing, and reading their counts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from research.suites.claims import Counts
from research.suites.records import SceneRecord
from research.suites.store import RecordStore

ViewScores = Mapping[str, Mapping[int, Counts]]  # by what is scored and by view


def run_missing(
    jobs: Iterable[tuple[str, int]],
    settings: str,
    score: Callable[[str, int], ViewScores],
    store: RecordStore,
    stopped: Callable[[], object],
) -> Iterator[tuple[str, int]]:
    """Make the records that are missing in ``store``; yields each job before it is run.

    Args:
        jobs: Names of arms and numbers of scenes.
        settings: Digest of what the records are made with.
        score: An arm on a scene.
        store: Records that are there are kept and not made again.
        stopped: Asked before each; once it says so (anything true), the run ends.
    """
    for name, number in jobs:
        if store.find(SceneRecord, settings, name, number) is not None:
            continue
        if stopped():
            return
        yield name, number
        rows = {
            f"{kind}/{view}": tuple(tuple(int(n) for n in row) for row in counts)
            for kind, views in score(name, number).items()
            for view, counts in views.items()
        }
        store.add(SceneRecord(settings=settings, weights=name, room=number, confusions=rows))


def counts_of(record: SceneRecord) -> Iterator[tuple[str, int, Counts]]:
    """What is scored, view and counts of a record that ``run_missing`` has made."""
    for key, rows in record.confusions.items():
        kind, view = key.rsplit("/", 1)
        yield kind, int(view), np.array(rows, np.int64)
