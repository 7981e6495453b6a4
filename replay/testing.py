"""Replays inside tests: a log goes through the very pipeline of a robot, and the map is there to be asserted on."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from semantic_mapper.config import MapperConfig, check_quality, convert_config, read_toml
from semantic_mapper.errors import LogError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.nearest import NearestSurface, at, nearest
from semantic_mapper.queries.occupancy import State, occupancy
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.replay.compare import Comparison, Run, Tolerances, compare_runs, read_run
from semantic_mapper.replay.map_log import replay_log
from semantic_mapper.replay.run_folder import MAP_NAME
from semantic_mapper.replay.summary import SUMMARY_FILE

Settings = Mapping[str, Any] | Path | str | None
Quality = Literal["fast", "balanced", "reference"] | None


@dataclass(frozen=True, eq=False)
class ReplayedMap:
    """The map that a log has become, and the questions of tests to it. Points are (3,) metres in the world."""

    folder: Path  # what ``semantic-mapper map`` would have written: map, picture, summary
    voxel_map: VoxelMap
    summary: Mapping[str, Any]  # as in ``summary.json``
    root: Path  # what paths of stored runs are relative to
    update: bool = False  # store runs instead of comparing with them

    def __repr__(self) -> str:
        return f"<map of {self.mapped} frames, {self.blocks} blocks; see {self.folder}>"

    @cached_property
    def snapshot(self) -> MapSnapshot:
        """For all queries of ``semantic_mapper.queries``."""
        return MapMirror.of(self.voxel_map).snapshot()

    def class_at(self, point: ArrayLike, radius_m: float | None = None) -> str | None:
        """Name of the class of the surface at a point, as of ``queries.nearest.at``; None where nobody knows it."""
        labels, found = self.snapshot.label_set, int(at(self.snapshot, np.asarray(point)[None], radius_m).label[0])
        return None if found == labels.ignore_id else labels.names[labels.ids.index(found)]

    def nearest(self, class_name: str, point: ArrayLike, min_confidence: float = 0.0) -> NearestSurface | None:
        """The surface of a class nearest to a point: ``xyz``, ``distance_m``, ``confidence``; None = nowhere."""
        return nearest(self.snapshot, class_name, point, min_confidence)

    def is_free(self, point: ArrayLike) -> bool:
        """Whether a point is known to be free: neither occupied nor unknown."""
        return int(occupancy(self.snapshot, np.asarray(point)[None])[0]) == State.FREE

    @property
    def blocks(self) -> int:
        """Blocks of 8^3 voxels."""
        return self.voxel_map.block_count

    @property
    def mapped(self) -> int:
        """Frames that are in the map."""
        return int(self.summary["frames"]["fused"])

    @property
    def refused(self) -> list[str]:
        """Why frames were refused: a reason each of the first 50, labels that cannot be used included."""
        return [str(refusal["reason"]) for refusal in self.summary["refusals"]]

    @property
    def miou(self) -> float:
        """Of the rendered views against the labels of the log, 0..1; ``LogError`` without labels that count."""
        return self._score("miou")

    @property
    def map_miou(self) -> float:
        """Of the map's surface against the labels of the log, 0..1; ``LogError`` without labels that count."""
        return self._score("map_miou")

    def compare(self, stored: Path | str, **tolerances: float) -> Comparison:
        """Compare with an earlier run, as ``assert_like`` does."""
        allowed = convert_config(tolerances, Tolerances, "tolerances")
        return compare_runs(read_run(self.root / stored), Run(str(self.folder), self.voxel_map, self.summary), allowed)

    def store(self, target: Path | str) -> None:
        """Write what ``assert_like`` needs of this run to a folder, made if missing."""
        folder = self.root / target
        folder.mkdir(parents=True, exist_ok=True)
        for name in (MAP_NAME, SUMMARY_FILE):
            shutil.copyfile(self.folder / name, folder / name)

    def assert_like(self, stored: Path | str, **tolerances: float) -> None:
        """Fail where this run is not as an earlier one, saying what differs; ``pytest --update-runs`` stores it there.

        ``stored`` is a folder with ``map.npz`` and ``summary.json``, or a map alone, relative to pytest's root folder;
        ``tolerances`` are score, surface_m and labels. Raises ConfigError: no such tolerance, or a folder without a
        run. MapError: a damaged map.
        """
        target = self.root / stored
        if self.update:
            self.store(target)
            return
        if not target.exists():
            raise AssertionError(f"no run is stored at {target}; look at {self.folder}, then `pytest --update-runs`")
        comparison = self.compare(stored, **tolerances)
        if not comparison.equal:
            lines = [f"the map is not as {target}; see {self.folder}", *map(str, comparison.differences)]
            raise AssertionError("\n  ".join([*lines, *comparison.notes]))

    def _score(self, name: str) -> float:
        value = self.summary["metrics"][name]
        if value is None:
            raise LogError(f"{self.folder}: nothing to score: no frame has labels that the weights have not seen")
        return float(value)


class LogReplays:
    """Replays logs, each once for the same settings, however many tests ask for it.

    Relative paths begin at ``root``; ``make_folder`` gives a new folder for the results of a replay, by the log's name.
    """

    def __init__(self, root: Path, make_folder: Callable[[str], Path], *, update: bool = False) -> None:
        self._root = root
        self._make_folder = make_folder
        self._update = update
        self._done: dict[str, ReplayedMap] = {}

    def __call__(
        self,
        log: Path | str,
        *,
        weights: Path | str | None = None,
        config: Settings = None,
        quality: Quality = None,
        max_frames: int = 0,
    ) -> ReplayedMap:
        """Replay a log (.mcap) through ``MappingPipeline.step``, as ``semantic-mapper map`` does: by weights, None =
        those that ship, and a config of the mapper, a TOML file or its sections as a dict; ``max_frames`` 0 means all.

        Raises LogError: the log cannot be read, or none of its frames can be mapped. WeightsError, ConfigError,
        MapError: as of ``Mapper.load`` and ``MappingPipeline.step``.
        """
        log = self._root / log
        weights = None if weights is None else self._root / weights
        where = "config of the replay" if isinstance(config, Mapping) else str(config)
        data = dict(config) if isinstance(config, Mapping) else read_toml(self._root / config) if config else {}
        data |= {} if quality is None else {"quality": quality}
        mapper = convert_config(data, MapperConfig, where)
        check_quality(data, mapper.quality, where)
        key = repr((log, weights, mapper, max_frames))
        if key not in self._done:
            folder = self._make_folder(log.stem)
            summary, session = replay_log(log, folder, weights, mapper, max_frames)
            self._done[key] = ReplayedMap(folder, session.pipeline.voxel_map, summary, self._root, self._update)
        return self._done[key]
