"""Two runs of one log, compared: what their summaries count and score, and how far their maps are apart."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from semantic_mapper.config import AtLeastZero, Config
from semantic_mapper.mapping.map_types import require_same_scale
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.run_folder import map_path
from semantic_mapper.replay.summary import SUMMARY_FILE, dig, read_summary

COUNTS = ("published", "fused", "dropped", "refused", "labels_refused", "scored")  # below ``frames`` of a summary
SCORES = (
    "metrics.miou",
    "metrics.total_accuracy",
    "metrics.average_accuracy",
    "metrics_per_image.miou",
    "metrics.map_miou",
)


class Tolerances(Config, frozen=True):
    """The largest difference that is no difference. Counts have none.

    A replay repeats bit for bit on one machine with one number of threads. These defaults leave room for another CPU or
    number of threads, where convolutions round otherwise.
    """

    score: AtLeastZero = 0.005  # of mIoU and accuracies, 0..1
    surface_m: AtLeastZero = 0.005  # 95th percentile of the distances to the other surface, the larger of both ways
    labels: AtLeastZero = 0.01  # fraction of the surface that both have whose nearest point has another class


class Run(NamedTuple):
    """One run of a log: its name for people, its map, and its summary, None where only the map is known."""

    name: str
    voxel_map: VoxelMap
    summary: Mapping[str, Any] | None


def read_run(path: Path) -> Run:
    """Read the folder that a replay or a mapper node has left, or a saved map alone.

    Raises ConfigError: no map there, a log, or a folder with a damaged summary. MapError: a damaged map.
    """
    voxel_map = VoxelMap.load(map_path(path))
    # A mapper saves its map before its summary.
    summary = read_summary(path) if (path / SUMMARY_FILE).exists() else None
    return Run(str(path), voxel_map, summary)


@dataclass(frozen=True, slots=True)
class Difference:
    """One figure of two runs, None where one has none; the distance of both, and the largest that is no difference."""

    name: str
    a: float | None
    b: float | None
    difference: float | None
    allowed: float = 0.0

    @property
    def within(self) -> bool:
        """Whether the runs are equal here."""
        return self.difference is not None and self.difference <= self.allowed

    def __str__(self) -> str:
        """For people."""
        a, b, apart = ("-" if value is None else f"{value:.6g}" for value in (self.a, self.b, self.difference))
        return f"{self.name}: {a} and {b}, {apart} apart, allowed {self.allowed:g}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two runs, compared: figures, what else differs, and what could not be compared."""

    figures: list[Difference]
    notes: list[str]

    @property
    def differences(self) -> list[Difference]:
        """Figures beyond their tolerances."""
        return [figure for figure in self.figures if not figure.within]

    @property
    def equal(self) -> bool:
        """Whether every figure is within its tolerance."""
        return not self.differences

    def to_plain(self) -> dict[str, Any]:
        """As data for JSON."""
        figures = [asdict(figure) | {"within": figure.within} for figure in self.figures]
        return {"equal": self.equal, "figures": figures, "notes": self.notes}


def compare_runs(a: Run, b: Run, tolerances: Tolerances) -> Comparison:
    """Compare what two runs counted and scored, and their maps; without both summaries the maps alone.

    Raises MapError: only one of the maps is in metres.
    """
    figures = [*_map_figures(a.voxel_map, b.voxel_map, tolerances)]
    if a.summary is None or b.summary is None:
        alone = [run.name for run in (a, b) if run.summary is None]
        return Comparison(figures, [f"{name} is a map alone: counts and scores are not compared" for name in alone])
    return Comparison([*_summary_figures(a.summary, b.summary, tolerances.score), *figures], [*_notes(a, b)])


def _summary_figures(a: Mapping[str, Any], b: Mapping[str, Any], score: float) -> Iterator[Difference]:
    for path, allowed in {**{f"frames.{name}": 0.0 for name in COUNTS}, **dict.fromkeys(SCORES, score)}.items():
        of_a, of_b = dig(a, path), dig(b, path)
        if path not in SCORES or (of_a, of_b) != (None, None):
            apart = None if of_a is None or of_b is None else abs(of_a - of_b)
            yield Difference(path, of_a, of_b, apart, allowed)
    refused = [{(r["seq"], r["stamp_ns"]) for r in summary.get("refusals") or []} for summary in (a, b)]
    only_a, only_b = len(refused[0] - refused[1]), len(refused[1] - refused[0])
    yield Difference("refused alone", only_a, only_b, only_a + only_b)


def _map_figures(a: VoxelMap, b: VoxelMap, tolerances: Tolerances) -> Iterator[Difference]:
    require_same_scale(a.scale_known, b.scale_known, "compare")
    sizes = a.config.voxel_size_m, b.config.voxel_size_m
    yield Difference("voxel_size_m", *sizes, abs(sizes[0] - sizes[1]))
    names = set(a.label_set.names), set(b.label_set.names)
    yield Difference("classes", len(names[0]), len(names[1]), len(names[0] ^ names[1]))
    for name, mine, theirs in zip(("surface_m", "labels"), _distances(a, b), _distances(b, a), strict=True):
        largest = None if mine is None or theirs is None else max(mine, theirs)
        yield Difference(name, mine, theirs, largest, getattr(tolerances, name))


def _distances(a: VoxelMap, b: VoxelMap) -> tuple[float | None, float | None]:
    """How far the surface of ``a`` is from that of ``b`` (95th percentile, metres), and the fraction of it within a
    voxel whose nearest point has another class; None where only one of the maps has a surface, or nothing in common."""
    mine, others = a.points(), b.points()
    if not len(mine.xyz) or not len(others.xyz):
        return (0.0, 0.0) if len(mine.xyz) == len(others.xyz) else (None, None)
    distance, nearest = cKDTree(others.xyz).query(mine.xyz, workers=-1)
    common = distance <= max(a.config.voxel_size_m, b.config.voxel_size_m)
    other = _names(a)[mine.label[common]] != _names(b)[others.label[nearest[common]]]
    return float(np.percentile(distance, 95)), float(other.mean()) if len(other) else None


def _names(voxel_map: VoxelMap) -> NDArray[np.str_]:
    names = dict(zip(voxel_map.label_set.ids, voxel_map.label_set.names, strict=True))
    return np.array([names.get(i, "unknown") for i in range(256)])


def _notes(a: Run, b: Run) -> Iterator[str]:
    for path in ("source", "weights.file", "stopped_by", "config", "versions"):
        of_a, of_b = (_flat({path: dig(run.summary or {}, path)}) for run in (a, b))
        for key in sorted(of_a.keys() | of_b.keys()):
            if of_a.get(key) != of_b.get(key):
                yield f"{key}: {of_a.get(key)} and {of_b.get(key)}"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat
