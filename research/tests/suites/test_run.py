from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from research.evaluation.sheet import draw_sheet
from research.suites.figures import compare, view_figures
from research.suites.records import CalibrationRecord, MapRecord, RoomRecord
from research.suites.run import Progress, room_records, run_suite, sheet_rows
from research.suites.store import RecordStore
from research.tests.suites.tiny import ROOM, tiny_contestant, tiny_suite
from semantic_mapper.labels import ROOMS

ROOT = Path(__file__).resolve().parents[3]


def silent(progress: Progress) -> None:
    pass


def test_a_second_call_makes_only_what_is_missing(tmp_path: Path) -> None:
    suite, path, pictures = tiny_suite(rooms=2), tmp_path / "run.jsonl", tmp_path / "views"
    one, two = tiny_contestant(0), tiny_contestant(1)
    run_suite(tiny_suite(rooms=1), [one], RecordStore(path), pictures, silent)
    before = path.read_bytes()
    seen: list[Progress] = []
    store = RecordStore(path)
    run_suite(suite, [one, two], store, pictures, seen.append)
    after = path.read_bytes()
    assert after.startswith(before) and before.count(b"\n") == 1 and after.count(b"\n") == 4
    assert (seen[-1].done, seen[-1].total) == (4, 4)
    run_suite(suite, [one, two], RecordStore(path), pictures, silent)
    assert path.read_bytes() == after
    records = {c.name: room_records(suite, c, RecordStore(path)) for c in (one, two)}
    assert [r.room for r in records["tiny0"]] == [ROOM, ROOM + 1]
    found = compare(records["tiny0"], records["tiny1"])
    assert found is not None and found["scenes"] == 2 and found["low"] <= found["observed"] <= found["high"]
    assert compare(records["tiny0"][:1], records["tiny1"])["low"] is None
    assert compare(records["tiny0"][:1], records["tiny1"][1:]) is None
    figures = view_figures(records["tiny0"])
    assert (
        figures["rooms"] == 2 and figures["images"] == 4 and set(figures["per_room_miou"]) == {str(ROOM), str(ROOM + 1)}
    )
    rows = sheet_rows(suite, [one, two], store, pictures)
    assert len(rows) == 2 and set(rows[0].labels) == {"tiny0", "tiny1"}
    assert draw_sheet(rows, ["tiny0", "tiny1"], ROOMS, title="two rooms").shape[1] > 4 * 320


def test_a_stopped_run_keeps_what_is_done(tmp_path: Path) -> None:
    suite, store = tiny_suite(rooms=2), RecordStore(tmp_path / "run.jsonl")
    entry = tiny_contestant()

    def enough() -> bool:
        return len(room_records(suite, entry, store)) == 1

    run_suite(suite, [entry], store, tmp_path / "views", silent, enough)
    assert [r.room for r in room_records(suite, entry, store)] == [ROOM]


def map_record(room: int = 1) -> MapRecord:
    rows = ((1, 0),)
    return MapRecord(
        settings="s", weights="w", room=room, template="office", points=3, on_surface=1.0,
        confusion=rows, surface_confusion=rows, view_confusion=rows, view_miou=0.5,
        cast_confusion=rows, cast_view_confusion=rows,
        seen_confusion=rows, one_frame_confusion=rows,
        calibration=CalibrationRecord(count=(0, 3), confidence=(0.0, 2.7), right=(0.0, 2.0)),
    )  # fmt: skip


def test_records_come_back_as_they_were_and_by_their_kind(tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.jsonl"
    RecordStore(path).add(map_record())
    store = RecordStore(path)
    assert store.find(MapRecord, "s", "w", 1) == map_record()
    assert store.find(RoomRecord, "s", "w", 1) is None
    assert store.find(MapRecord, "s", "w", 2) is None


def test_a_line_that_was_cut_off_is_dropped_and_the_next_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    store = RecordStore(path)
    store.add(map_record(1))
    store.add(map_record(2))
    path.write_bytes(path.read_bytes()[:-20])
    again = RecordStore(path)
    assert again.find(MapRecord, "s", "w", 1) and again.find(MapRecord, "s", "w", 2) is None
    again.add(map_record(3))
    assert RecordStore(path).find(MapRecord, "s", "w", 3) == map_record(3)


def test_the_benchmark_needs_nothing_that_a_training_machine_lacks() -> None:
    program = (
        "import sys\n"
        "for name in ('scipy', 'open3d', 'depthai', 'zmq', 'mcap', 'zstandard'): sys.modules[name] = None\n"
        "import research.suites.run, research.suites.entries, research.cli.suite\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
