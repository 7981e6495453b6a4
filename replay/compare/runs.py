"""Compare two runs of one log: what their summaries say, and their maps laid over each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.compare.surface_match import (
    BlockMatch,
    SurfaceMatch,
    count_other_bits,
    label_changes,
    match_blocks,
    match_surfaces,
)
from semantic_mapper.replay.compare.tolerances import BITS, FIELDS, Tolerances, show
from semantic_mapper.replay.run_folder import MAP_NAME
from semantic_mapper.replay.summary import SUMMARY_FILE, dig, read_summary


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What one run of a log has left: of a replay, or of a mapper node.

    Args:
        name: For people.
        voxel_map: Its map.
        summary: Its ``summary.json``; None where only the map is known.
    """

    name: str
    voxel_map: VoxelMap
    summary: Mapping[str, Any] | None


def read_run(path: Path) -> Run:
    """Read the folder of a run, or a saved map alone.

    Raises:
        ConfigError: a folder with a damaged summary.
        MapError: no map there, or a damaged one.
    """
    if not path.is_dir():
        return Run(str(path), VoxelMap.load(path), None)
    voxel_map = VoxelMap.load(path / MAP_NAME)
    there = (path / SUMMARY_FILE).exists()  # a mapper saves its map before its summary
    return Run(str(path), voxel_map, read_summary(path) if there else None)


@dataclass(frozen=True, slots=True)
class FieldResult:
    """One field of a comparison.

    Args:
        name: In ``FIELDS``.
        a, b: Value of each run; None where it has none.
        difference: Between them, None where that is unknown; then the field differs.
        tolerance: That it is held against.
        detail: What else there is to know.
    """

    name: str
    a: float | None
    b: float | None
    difference: float | None
    tolerance: float
    detail: str = ""

    @property
    def within(self) -> bool:
        """Whether the runs are equal here."""
        return self.difference is not None and self.difference <= self.tolerance

    @property
    def title(self) -> str:
        """Name, and what else there is to know."""
        return f"{self.name} ({self.detail})" if self.detail else self.name

    def texts(self) -> tuple[str, str, str, str]:
        """A, B, difference and tolerance for people."""
        unit = FIELDS[self.name].unit
        a, b, difference, tolerance = (show(v, unit) for v in (self.a, self.b, self.difference, self.tolerance))
        return a, b, difference, tolerance


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two runs, compared.

    Args:
        a, b: The runs.
        exact: Whether every bit counted.
        fields: What was looked at, in the order of ``FIELDS``.
        label_changes: (class of A, class of B, points of A) at the common surface, the most frequent first.
        notes: What else differs, and what could not be compared.
        surfaces: A's beside B's, and B's beside A's.
        blocks: None for maps of other voxel sizes.
    """

    a: Run
    b: Run
    exact: bool
    fields: tuple[FieldResult, ...]
    label_changes: tuple[tuple[str, str, int], ...]
    notes: tuple[str, ...]
    surfaces: tuple[SurfaceMatch, SurfaceMatch]
    blocks: BlockMatch | None

    @property
    def equal(self) -> bool:
        """Whether every field is within its tolerance."""
        return all(field.within for field in self.fields)

    def differences(self) -> list[str]:
        """A line for each field beyond its tolerance."""
        lines: list[str] = []
        for field in self.fields:
            if not field.within:
                a, b, difference, tolerance = field.texts()
                lines.append(f"{field.title}: {a} and {b}, {difference} apart, allowed {tolerance}")
        return lines

    def to_plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {
            "a": self.a.name,
            "b": self.b.name,
            "equal": self.equal,
            "exact": self.exact,
            "fields": {
                f.name: {k: v for k, v in asdict(f).items() if k != "name"} | {"within": f.within} for f in self.fields
            },
            "label_changes": [{"a": a, "b": b, "points": count} for a, b, count in self.label_changes],
            "notes": list(self.notes),
        }


def compare_runs(a: Run, b: Run, tolerances: Tolerances, *, exact: bool = False) -> Comparison:
    """Compare runs field by field.

    Args:
        a, b: The runs; where one of them has no summary, only maps are compared.
        tolerances: Of each field; a field with an infinite one is left out.
        exact: Let nothing pass, whatever ``tolerances`` say, and compare the maps bit by bit, too.
    """
    surfaces, blocks = match_surfaces(a.voxel_map, b.voxel_map), match_blocks(a.voxel_map, b.voxel_map)
    found = [*_summary_fields(a, b), *_map_fields(a.voxel_map, b.voxel_map, surfaces, blocks)]
    allowed = {name: 0.0 if exact else getattr(tolerances, name, 0.0) for name in FIELDS}
    fields = [
        FieldResult(f.name, f.a, f.b, f.difference, allowed[f.name], f.detail)
        for f in found
        if allowed[f.name] != float("inf")
    ]
    if exact and blocks is not None:
        other = count_other_bits(a.voxel_map, b.voxel_map, blocks.common)
        fields.append(FieldResult(BITS, None, None, other + len(blocks.only_a) + len(blocks.only_b), 0))
    notes = tuple(_notes(a, b, blocks))
    return Comparison(a, b, exact, tuple(fields), tuple(label_changes(surfaces[0])), notes, surfaces, blocks)


class _Found(NamedTuple):
    """A field before it is judged."""

    name: str
    a: float | None
    b: float | None
    difference: float | None
    detail: str = ""


def _summary_fields(a: Run, b: Run) -> Iterator[_Found]:
    if a.summary is None or b.summary is None:
        mapped = a.voxel_map.frames, b.voxel_map.frames
        yield _Found("frames_mapped", *mapped, abs(mapped[0] - mapped[1]))
        return
    for name, kind in FIELDS.items():
        if kind.path:
            values = dig(a.summary, kind.path), dig(b.summary, kind.path)
            if values != (None, None):
                yield _Found(name, *values, _apart(*values))
    refused = _refused(a.summary), _refused(b.summary)
    alone = len(refused[0] - refused[1]), len(refused[1] - refused[0])
    yield _Found("refused_alone", *alone, sum(alone))
    of_a, of_b = (dig(s, "metrics.per_class") or {} for s in (a.summary, b.summary))
    scores = {name: (of_a.get(name) or 0.0, of_b.get(name) or 0.0) for name in (*of_a, *of_b)}
    if scores:
        name = max(scores, key=lambda n: abs(scores[n][0] - scores[n][1]))
        yield _Found("class_iou", *scores[name], abs(scores[name][0] - scores[name][1]), name)


def _map_fields(
    a: VoxelMap, b: VoxelMap, surfaces: tuple[SurfaceMatch, SurfaceMatch], blocks: BlockMatch | None
) -> Iterator[_Found]:
    sizes = a.config.voxel_size_m, b.config.voxel_size_m
    yield _Found("voxel_size_m", *sizes, abs(sizes[0] - sizes[1]))
    alone = set(a.label_set.names) - set(b.label_set.names), set(b.label_set.names) - set(a.label_set.names)
    yield _Found("classes", len(a.label_set), len(b.label_set), len(alone[0]) + len(alone[1]))
    if blocks is not None:
        only = len(blocks.only_a), len(blocks.only_b)
        of_a, of_b = (n + len(blocks.common) for n in only)
        shares = only[0] / max(of_a, 1), only[1] / max(of_b, 1)
        yield _Found("blocks", *shares, blocks.alone, f"{of_a:,} and {of_b:,}")
    both_empty = not any(len(s.points.xyz) for s in surfaces)
    for name, q in (("surface_median_m", 50), ("surface_p95_m", 95)):
        there, back = (0.0 if both_empty else s.percentile_m(q) for s in surfaces)
        yield _Found(name, there, back, None if there is None or back is None else max(there, back))
    looks = {
        "surface_alone": [s.share(~s.common) for s in surfaces],
        "labels": [s.share(s.relabelled, s.common) for s in surfaces],
        "confidence": [float(s.confidence_gap[s.common].mean()) if s.common.any() else 0.0 for s in surfaces],
    }
    for name, (of_a, of_b) in looks.items():
        yield _Found(name, of_a, of_b, max(of_a, of_b))


def _notes(a: Run, b: Run, blocks: BlockMatch | None) -> Iterator[str]:
    for run in (a, b):
        if run.summary is None:
            yield f"{run.name} is a map alone: frames and metrics are not compared"
    if blocks is None:
        yield "the maps have voxels of other sizes: their blocks are not compared"
    if a.summary is None or b.summary is None:
        return
    for name, path in (("log", "source"), ("weights", "weights.file"), ("stopped by", "stopped_by")):
        values = dig(a.summary, path), dig(b.summary, path)
        if values[0] != values[1]:
            yield f"{name}: {values[0]} and {values[1]}"
    for section in ("config", "versions"):
        of_a, of_b = (_flat(s.get(section) or {}) for s in (a.summary, b.summary))
        for key in sorted(of_a.keys() | of_b.keys()):
            if of_a.get(key) != of_b.get(key):
                yield f"{section} {key}: {of_a.get(key)} and {of_b.get(key)}"


def _apart(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else abs(a - b)


def _refused(summary: Mapping[str, Any]) -> set[tuple[int, int]]:
    return {(r["seq"], r["stamp_ns"]) for r in summary.get("refusals") or []}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat
