"""A run of the benchmark: room by room, every entry, each result on disk before the next begins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from research.evaluation.sheet import SheetRow
from research.suites.config import SuiteConfig, check_suite, settings_digest, suite_seeds
from research.suites.figures import image_note
from research.suites.protocols import Entry, RoomResult, run_room
from research.suites.records import RoomRecord
from research.suites.rooms import BenchmarkRoom, make_benchmark_room
from research.suites.store import RecordStore
from semantic_mapper.files import atomic_write
from semantic_mapper.log_events import get_logger

_log = get_logger(__name__)

SHEET_ROWS = 6


@dataclass(frozen=True, slots=True)
class Progress:
    """``done`` of ``total`` pairs of room and entry; ``note`` says what is being done."""

    done: float
    total: int
    note: str


def run_suite(
    suite: SuiteConfig,
    entries: Sequence[Entry],
    store: RecordStore,
    pictures: Path,
    on_progress: Callable[[Progress], None],
    stopped: Callable[[], object] = bool,
) -> None:
    """Make the records that are missing in ``store``, and beside them a picture of each room's first query view.

    Raises ConfigError: settings that no run can follow.

    Args:
        suite: What to run.
        entries: Which fields.
        store: Records that are there are kept and not made again.
        pictures: Folder for the label images of ``sheet_rows``.
        on_progress: Called with every step.
        stopped: Asked before each room, entry and step of a fitting; once it says so (anything true), the run
            ends. A room that is not done by then leaves no record.
    """
    check_suite(suite)
    settings, seeds = settings_digest(suite, "views"), suite_seeds(suite)
    total, done = len(seeds) * len(entries), 0
    for seed in seeds:
        missing = [c for c in entries if store.find(RoomRecord, settings, c.digest, seed) is None]
        done += len(entries) - len(missing)
        on_progress(Progress(done, total, f"room {seed}"))
        room = make_benchmark_room(seed, suite) if missing and not stopped() else None
        for entry in missing:
            if room is None or stopped():
                return
            name = entry.name
            result = run_room(
                room,
                entry,
                suite,
                lambda fraction, at=done, name=name: on_progress(Progress(at + fraction, total, f"fit {name}")),
                stopped,
            )
            if result is None:
                return
            _keep_picture(pictures, room, result)
            store.add(result.record)
            done += 1
            miou = np.mean([i.miou for i in result.record.images if i.miou is not None] or [np.nan])
            _log.debug("room_scored", room=seed, weights=name, miou=round(float(miou), 3))
            on_progress(Progress(done, total, f"room {seed}, {name}"))


def room_records(suite: SuiteConfig, entry: Entry, store: RecordStore) -> list[RoomRecord]:
    """The records of a entry that are there, in the order of the split."""
    settings = settings_digest(suite, "views")
    found = (store.find(RoomRecord, settings, entry.digest, seed) for seed in suite_seeds(suite))
    return [record for record in found if record is not None]


def sheet_rows(suite: SuiteConfig, entries: Sequence[Entry], store: RecordStore, pictures: Path) -> list[SheetRow]:
    """Up to six rooms of the run for the contact sheet, evenly spread; those whose pictures are gone are left out."""
    settings = settings_digest(suite, "views")
    rows: list[SheetRow] = []
    seeds = suite_seeds(suite)
    for at in np.linspace(0, len(seeds) - 1, min(SHEET_ROWS, len(seeds))).round():
        seed = seeds[int(at)]
        labels, notes = {}, {}
        name, rgb, truth = "", None, None
        for entry in entries:
            record = store.find(RoomRecord, settings, entry.digest, seed)
            path = _picture_path(pictures, settings, entry.digest, seed)
            if record is None or not path.exists():
                continue
            with np.load(path) as data:
                rgb, truth, labels[entry.name] = data["rgb"], data["truth"], data["label"]
            name = f"room {seed} ({record.template}), frame {record.images[0].frame}"
            notes[entry.name] = image_note(record.images[0])
        if rgb is not None and truth is not None:
            rows.append(SheetRow(name, rgb, truth, labels, notes))
    return rows


def _keep_picture(pictures: Path, room: BenchmarkRoom, result: RoomResult) -> None:
    pictures.mkdir(parents=True, exist_ok=True)
    query, answer = next(iter(result.answers.items()))
    record = result.record
    with atomic_write(_picture_path(pictures, record.settings, record.weights, room.seed)) as file:
        np.savez_compressed(
            file, rgb=room.current[query].rgb, truth=room.truth[query].label, label=answer.prediction.label
        )


def _picture_path(pictures: Path, settings: str, weights: str, room: int) -> Path:
    return pictures / f"{room}-{settings}-{weights}.npz"
