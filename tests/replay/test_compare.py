"""Comparing runs: each figure catches the difference it is there for, and a tolerance lets it pass."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.compare import COUNTS, SCORES, Comparison, Run, Tolerances, compare_runs, read_run
from tests.mapping.rendered_views import LABELS, small_map
from tests.nodes.support import write_weights
from tests.replay.runs import VOXEL_M, alone, replayed, wall
from tests.small import tiny_frames


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_weights(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


@pytest.fixture(scope="module")
def run(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return replayed(weights, tiny_frames(), tmp_path_factory.mktemp("runs") / "first")[0]


def differing(comparison: Comparison) -> set[str]:
    return {figure.name for figure in comparison.differences}


def compare_maps(a: VoxelMap, b: VoxelMap, **tolerances: float) -> Comparison:
    return compare_runs(alone(a, "a"), alone(b, "b"), Tolerances(**tolerances))


def test_a_log_replayed_twice_is_equal_without_any_tolerance(run: Run, weights: Path, tmp_path: Path) -> None:
    replayed(weights, tiny_frames(), tmp_path / "again")
    comparison = compare_runs(run, read_run(tmp_path / "again"), Tolerances(score=0, surface_m=0, labels=0))
    assert comparison.equal and not comparison.notes and comparison.to_plain()["equal"] is True


def test_a_missing_and_another_refused_frame_are_caught(run: Run, weights: Path, tmp_path: Path) -> None:
    fewer, _ = replayed(weights, tiny_frames()[:-1], tmp_path / "fewer")
    assert differing(compare_runs(run, fewer, Tolerances())) >= {"frames.published", "frames.fused", "frames.scored"}
    runs: list[Run] = []
    for lost in (2, 3):
        frames = list(tiny_frames())
        frames[lost] = replace(frames[lost], T_world_camera=np.full((4, 4), np.nan))
        runs.append(replayed(weights, frames, tmp_path / str(lost))[0])
    found = differing(compare_runs(runs[0], runs[1], Tolerances(score=1)))
    assert "refused alone" in found and "frames.refused" not in found


@pytest.mark.parametrize("path", [*(f"frames.{name}" for name in COUNTS), *SCORES])
def test_each_figure_of_the_summary_is_compared_by_itself(run: Run, path: str) -> None:
    assert run.summary is not None
    summary = copy.deepcopy(dict(run.summary))
    section, key = path.split(".")
    summary[section][key] += 2 if section == "frames" else 0.05
    other = run._replace(summary=summary)
    assert differing(compare_runs(run, other, Tolerances())) == {path}
    assert compare_runs(run, other, Tolerances(score=0.06)).equal == (section != "frames")
    summary[section][key] = None
    assert differing(compare_runs(run, other, Tolerances(score=1))) == {path}, "a figure that is gone differs"


def test_other_settings_and_logs_are_noted_and_no_difference(run: Run) -> None:
    assert run.summary is not None
    config = {**run.summary["config"], "quality": "another"}
    comparison = compare_runs(run, run._replace(summary={**run.summary, "config": config, "source": "s"}), Tolerances())
    assert comparison.equal and [note.split(":")[0] for note in comparison.notes] == ["source", "config.quality"]


def test_maps_are_compared_by_their_surface_and_classes_from_both_sides() -> None:
    assert compare_maps(wall(), wall()).equal
    assert differing(compare_maps(wall(1.0), wall(1.012))) == {"surface_m"}
    assert compare_maps(wall(1.0), wall(1.012), surface_m=0.03).equal
    for pair in ((wall(), wall(cut=40)), (wall(cut=40), wall())):
        assert differing(compare_maps(*pair)) == {"surface_m"}
    relabelled = compare_maps(wall(), wall(other=1))
    assert differing(relabelled) == {"labels"} and relabelled.differences[0].a == pytest.approx(0.5, abs=0.05)
    assert compare_maps(wall(), wall(other=1), labels=0.6).equal


def test_classes_are_compared_by_name_and_other_voxels_and_empty_maps_differ() -> None:
    renamed = make_label_set("renamed", ("desk", "cup", "wall"), ids=LABELS.ids)
    assert differing(compare_maps(wall(), wall(labels=renamed))) == {"classes", "labels"}
    assert "voxel_size_m" in differing(compare_maps(wall(), wall(voxel_size_m=0.025)))
    empty = small_map(voxel_size_m=VOXEL_M)
    assert compare_maps(empty, empty).equal
    assert differing(compare_maps(empty, wall())) == {"surface_m", "labels"}


def test_folders_without_a_run_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no map\.npz in this folder"):
        read_run(tmp_path)
    wall().save(tmp_path / "map.npz")
    assert read_run(tmp_path).summary is None, "a map alone"
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(ConfigError, match="is not the summary of a replay"):
        read_run(tmp_path)
