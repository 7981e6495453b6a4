"""Run a benchmark from the command line: progress, tables, JSON and the contact sheet."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from itertools import combinations
from pathlib import Path
from typing import Any

from rich.table import Table

from research.cli.suite_table import difference_lines, map_rows_table, rows_table, suite_table
from research.evaluation.sheet import draw_sheet
from research.plots import cannot_draw
from research.scenes.suite import ROOMS_SUITE
from research.suites.config import SuiteConfig, own_image_suite, settings_digest, suite_seeds
from research.suites.entries import load_entries
from research.suites.figures import (
    compare,
    compare_maps,
    compare_surfaces,
    compare_with_baselines,
    compare_with_carried,
    comparison_rows,
    draw_fit_curves,
    map_figures,
    map_row_figures,
    row_figures,
    view_figures,
    worst_room,
)
from research.suites.protocols import Entry
from research.suites.records import MapRecord, RoomRecord
from research.suites.run import Progress, room_records, run_suite, sheet_rows
from research.suites.store import RecordStore
from semantic_mapper import __version__
from semantic_mapper.config import to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.nesf import NesfWeights, find_nesf, smoothed_votes
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.files import write_json
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.console import FrameProgress, Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.page import Section, picture_files, write_page
from semantic_mapper.replay.run_folder import prepare_file

PACKAGES = ("torch", "numpy")


def run_suite_verb(
    suite: SuiteConfig,
    weights: Sequence[Path],
    kinds: Sequence[str],
    maps: bool,
    json_file: Path | None,
    *,
    print_json: bool = False,
    refine: Path | None = None,
) -> int:
    """Run what is missing, then print, write and draw what there is.

    Beside the JSON lie the records of the rooms (``.jsonl``), their pictures (``.views``), the sheet (``.png``) and, of
    what was fitted, mIoU against seconds (``.curves.png``). Raises WeightsError, ConfigError, MapError: with what is
    wrong and the mend.

    Args:
        weights: Files under test; the shipped ones where neither these nor ``kinds`` are given.
        kinds: Fields with random weights that are fitted to each room; not with protocol "generalize".
        json_file: Where to write; None = named after the suite.
        print_json: Print JSON, and nothing else.
        refine: Weights that refine the maps of the first entry; with ``maps``.

    Returns:
        The exit code: 0, or that of the signal that ended the run.
    """
    if kinds and suite.protocol == "generalize":
        raise ConfigError("--kind has random weights, which must be fitted; --protocol scratch, or finetune")
    output = Output.guarded()
    output.quiet = print_json
    keep_freed_memory()
    paths = list(weights) or ([] if kinds else [default_checkpoint_path()])
    out = json_file or Path("runs") / f"{_file_stem(suite)}.json"
    prepare_file(out)
    entries = load_entries(paths, kinds)
    labels = entries[0].field.label_set  # of the maps
    refiner = None if refine is None else _Refiner(suite, find_nesf(refine, labels), smoothed_votes(labels))
    store, pictures = RecordStore(out.with_suffix(".jsonl")), out.with_suffix(".views")
    with StopRequest() as stop:
        with frame_progress("benchmark", None, unit="%") as bar:
            bar.start(100)
            run_suite(suite, entries, store, pictures, lambda p: _show(bar, p), lambda: stop)
        if maps and not stop:
            with frame_progress("map the rooms", None, unit="maps") as bar:
                _map_rooms(suite, entries, paths, store, bar, stop, refiner)
        found = _collect(suite, entries, store, maps, refiner)
        write_json(out, found)
        table, lines = suite_table(found), difference_lines(found)
        output.print(table)
        if found["rows"]:
            output.print(rows_table(found))
        if found["map_rows"]:
            output.print(map_rows_table(found))
        for line in lines:
            output.print(line)
        if (refined := found.get("refined")) is not None:
            output.print(
                f"refined, worst of {refined['rooms']} rooms: {refined['worst_change'] * 100:+.1f} mIoU points "
                f"(room {refined['worst_room']})"
            )
        output.print(f"written to {out}")
        if reason := cannot_draw():
            output.print(f"no pictures: {reason}")
        pictures = [] if reason else list(_draw(suite, entries, store, found, out))
        for picture in pictures:
            output.print(f"picture: {picture}")
        write_suite_report(page := out.with_suffix(".html"), table, lines, pictures, found)
        output.print(f"page: {page}")
        if print_json:
            output.json(found)
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the same command goes on from here", style="yellow")
        return stop.exit_code


def _draw(
    suite: SuiteConfig, entries: Sequence[Entry], store: RecordStore, found: Mapping[str, Any], out: Path
) -> Iterator[Path]:
    """Write the contact sheet, and the curves of what was fitted; yields the files."""
    if rows := sheet_rows(suite, entries, store, out.with_suffix(".views")):
        names = [c.name for c in entries]
        title, _, how = found["title"].partition(": ")  # one line of a sheet of three columns is too short for both
        picture = draw_sheet(rows, names, ROOMS_SUITE.label_set, title=title, subtitle=how)
        write_picture(sheet := out.with_suffix(".png"), picture)
        yield sheet
    figures = {name: entry["figures"] for name, entry in found["weights"].items()}
    if (picture := draw_fit_curves(figures, found["title"])) is not None:
        write_picture(curves := out.with_suffix(".curves.png"), picture)
        yield curves


def _file_stem(suite: SuiteConfig) -> str:
    """One file for each table that a comparison usually has."""
    depth = {"on": "depth", "computed": "computed-depth", "off": "no-depth"}[suite.depth]
    own = "" if suite.own_image else "novel-"
    views = f"{suite.sources}-{own}" if suite.protocol == "generalize" else ""
    views += "hard-" if suite.current == "hard" else ""
    return f"rooms-{suite.split}-{suite.protocol}-{views}{depth}-{suite.tier.width}"


def _show(bar: FrameProgress, progress: Progress) -> None:
    bar.set(int(100 * progress.done / max(progress.total, 1)), progress.note)


def _map_rooms(
    suite: SuiteConfig,
    entries: Sequence[Entry],
    paths: Sequence[Path],
    store: RecordStore,
    bar: FrameProgress,
    stop: StopRequest,
    refiner: _Refiner | None,
) -> None:
    """Make the map records that are missing; of fields that fuse views also those of each frame's own image alone."""
    # Loads the mapping pipeline, which the rest of a run does without.
    from research.evaluation.room_map import map_room, refine_room

    seeds, alone = suite_seeds(suite), own_image_suite(suite)
    runs = [(suite, entry, path) for entry, path in zip(entries, paths, strict=True)]
    runs += [(alone, entry, path) for _, entry, path in runs if not entry.field.needs_own_view]
    bar.start(len(seeds) * len(runs))
    for seed in seeds:
        if refiner is not None and not stop and refiner.missing(store, entries[0], seed):
            for record in refine_room(seed, paths[0], entries[0].digest, suite, refiner.networks):
                store.add(record)
        for how, entry, path in runs:
            if stop:
                return
            if store.find(MapRecord, settings_digest(how, "map"), entry.digest, seed) is None:
                store.add(map_room(seed, path, entry.digest, how))
            bar.advance()


def _collect(
    suite: SuiteConfig, entries: Sequence[Entry], store: RecordStore, maps: bool, refiner: _Refiner | None
) -> dict[str, Any]:
    """All figures of the run as plain data."""
    seeds = suite_seeds(suite)
    records = {c.name: room_records(suite, c, store) for c in entries}
    found: dict[str, Any] = {"title": _title(suite, len(seeds)), "suite": to_plain(suite), "weights": {}}
    for entry in entries:
        field = entry.field
        found["weights"][entry.name] = {
            "file": entry.file or None,
            "digest": entry.digest,
            "kind": field.kind,
            "parameters": sum(p.numel() for p in field.parameters()),
            "figures": view_figures(records[entry.name]),
            "map": map_figures(_map_records(suite, entry, store)) if maps else None,
        }
    pairs = combinations(records, 2)
    found["differences"] = [
        {"first": a, "second": b, **difference}
        for a, b in pairs
        if (difference := compare(records[a], records[b], seed=suite.seed)) is not None
    ]
    found["differences"] += [
        {"first": name, "second": "labels carried by depth", **difference}
        for name, made in records.items()
        if (difference := compare_with_carried(made, seed=suite.seed)) is not None
    ]
    found["rows"], more = _rows(suite, entries, records)
    found["differences"] += more
    found["map_rows"], more = _map_rows(suite, entries, store) if maps else ({}, [])
    found["differences"] += more
    if refiner is not None:
        rows, more, found["refined"] = refiner.figures(store, entries[0])
        found["map_rows"] |= rows
        found["differences"] += more
    found["complete"] = all(len(r) == len(seeds) for r in records.values())
    found["versions"] = {"semantic_mapper": __version__} | {name: metadata.version(name) for name in PACKAGES}
    return found


def _rows(
    suite: SuiteConfig, entries: Sequence[Entry], records: Mapping[str, list[RoomRecord]]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The first multi-view field beside what its views say without it, and differences to each; nothing where fitted.

    The row ``unet`` is the first per-image network among the weights, None without one.
    """
    fused = next((entry for entry in entries if not entry.field.needs_own_view), None)
    if fused is None or suite.protocol != "generalize" or not records[fused.name]:
        return {}, []
    ours, kind = records[fused.name], fused.field.kind
    rows: dict[str, Any] = {kind: row_figures(ours)} | comparison_rows(ours)
    differences = [
        {"first": kind, "second": name, **found}
        for name, found in compare_with_baselines(ours, seed=suite.seed).items()
    ]
    image = next((entry for entry in entries if entry.field.needs_own_view), None)
    rows["unet"] = row_figures(records[image.name]) if image is not None and records[image.name] else None
    if image is not None and (found := compare(ours, records[image.name], seed=suite.seed)) is not None:
        differences.append({"first": kind, "second": "unet", **found})
    return rows, differences


def _map_rows(
    suite: SuiteConfig, entries: Sequence[Entry], store: RecordStore
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Maps of the first multi-view field, of its own images and voxel votes, and of a U-Net's; with differences."""
    fused = next((entry for entry in entries if not entry.field.needs_own_view), None)
    if fused is None:
        return {}, []
    image = next((entry for entry in entries if entry.field.needs_own_view), None)
    ours, kind = _map_records(suite, fused, store), f"{fused.field.kind} map"
    others = {"own image + votes": _map_records(own_image_suite(suite), fused, store)}
    others["unet + votes"] = [] if image is None else _map_records(suite, image, store)
    rows = {kind: map_row_figures(ours) if ours else None}
    rows |= {name: map_row_figures(records) if records else None for name, records in others.items()}
    differences = [
        {"first": kind, "second": name, **found}
        for name, records in others.items()
        if (found := compare_maps(ours, records, seed=suite.seed)) is not None
    ]
    return rows, differences


class _Refiner:
    """Maps of the first entry refined by weights, and for comparison smoothed without any."""

    def __init__(self, suite: SuiteConfig, weights: NesfWeights, smoothed: NesfWeights) -> None:
        self._suite = suite
        self._plain = settings_digest(suite, "map")
        self._settings = {
            "refined": f"{self._plain}-refined-{weights.digest[:16]}",
            "smoothed": f"{self._plain}-smoothed",
        }
        self.networks = {self._settings["refined"]: weights, self._settings["smoothed"]: smoothed}

    def missing(self, store: RecordStore, entry: Entry, seed: int) -> bool:
        """Whether records of a room are still to be made."""
        settings = (self._plain, *self.networks)
        return any(store.find(MapRecord, s, entry.digest, seed) is None for s in settings)

    def figures(
        self, store: RecordStore, entry: Entry
    ) -> tuple[dict[str, Any], list[dict[str, Any]], dict[str, Any] | None]:
        """Rows of the table of maps, differences to the plain maps, and the worst room; of the rooms done so far."""
        seeds = [seed for seed in suite_seeds(self._suite) if not self.missing(store, entry, seed)]
        if not seeds:
            return {}, [], None
        plain, *others = (
            [record for seed in seeds if (record := store.find(MapRecord, settings, entry.digest, seed)) is not None]
            for settings in (self._plain, *self._settings.values())
        )
        rows: dict[str, Any] = {}
        differences: list[dict[str, Any]] = []
        for name, records in zip(self._settings, others, strict=True):
            rows[name] = map_row_figures(records)
            for where, found in (
                ("points", compare_maps(records, plain, seed=self._suite.seed)),
                ("true surface", compare_surfaces(records, plain, seed=self._suite.seed)),
            ):
                if found is not None:
                    differences.append({"first": f"{name} ({where})", "second": "as mapped", **found})
        room, change = worst_room(others[0], plain)
        return rows, differences, {"rooms": len(seeds), "worst_room": room, "worst_change": change}


def _map_records(suite: SuiteConfig, entry: Entry, store: RecordStore) -> list[MapRecord]:
    settings = settings_digest(suite, "map")
    records = (store.find(MapRecord, settings, entry.digest, seed) for seed in suite_seeds(suite))
    return [record for record in records if record is not None]


def _title(suite: SuiteConfig, rooms: int) -> str:
    own = ", the query's own image among them" if suite.own_image else ""
    sources = f"{suite.views} {suite.sources} views{own}" if suite.protocol == "generalize" else _fit_title(suite)
    sources += ", hard query images" if suite.current == "hard" else ""
    depth = {"on": "with depth", "computed": "with computed depth", "off": "without depth"}[suite.depth]
    width, count = suite.tier.width, "1 room" if rooms == 1 else f"{rooms} rooms"
    return f"ROOMS {suite.split}, {count}, {suite.protocol}: {sources}, {depth}, {width}x{width * 3 // 4}"


def _fit_title(suite: SuiteConfig) -> str:
    """What a field was fitted to, and for how long."""
    scene = suite.scene
    budget = " or ".join([f"{scene.seconds:g} s"] * (scene.seconds > 0) + [f"{scene.steps} steps"] * (scene.steps > 0))
    more = f" and {scene.unlabelled} without labels" if scene.unlabelled else ""
    known = "" if scene.labelled_sources else ", labels kept back"
    return f"{scene.keyframes} keyframes{more}{known}, {budget}, {suite.views} views"


def write_suite_report(path: Path, table: Table, lines: Sequence[str], pictures: Sequence[Path], found: Any) -> None:
    """Write the report of a benchmark run with its pictures. Raises ConfigError: it cannot be written."""
    figures = Section(notes=lines, tables=[table])
    drawn = Section(pictures=list(picture_files(*((path, path.name) for path in pictures))))
    write_page(path, found["title"], [figures, drawn, Section(folded={"All figures": json.dumps(found, indent=1)})])
