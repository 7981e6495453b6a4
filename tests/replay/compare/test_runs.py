"""Comparing runs: each field catches the difference it is there for, and a tolerance lets it pass."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import PANEL
from semantic_mapper.replay.compare.picture import (
    CAPTION,
    COLUMN,
    GAP,
    HEADER,
    MARGIN,
    ONLY_A,
    PANEL_HEIGHT,
    RELABELLED,
    draw_comparison,
)
from semantic_mapper.replay.compare.runs import Comparison, Run, compare_runs, read_run
from semantic_mapper.replay.compare.surface_match import match_surfaces
from semantic_mapper.replay.compare.tolerances import FIELDS, Tolerances
from tests.figures import figure_of, misplaced_texts
from tests.mapping.rendered_views import LABELS, small_map
from tests.nodes.support import write_weights
from tests.replay.runs import VOXEL_M, alone, replayed, wall
from tests.small import tiny_config, tiny_frames

ANY = float("inf")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_weights(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


@pytest.fixture(scope="module")
def run(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return replayed(weights, tiny_frames(), tmp_path_factory.mktemp("runs") / "first")[0]


def differing(comparison: Comparison) -> set[str]:
    return {field.name for field in comparison.fields if not field.within}


def compare_maps(a: VoxelMap, b: VoxelMap, **tolerances: float) -> Comparison:
    return compare_runs(alone(a, "a"), alone(b, "b"), Tolerances(**tolerances))


def test_a_log_replayed_twice_is_equal_to_the_bit(run: Run, weights: Path, tmp_path: Path) -> None:
    again, _ = replayed(weights, tiny_frames(), tmp_path / "again")
    comparison = compare_runs(run, read_run(tmp_path / "again"), Tolerances(), exact=True)
    assert comparison.equal and not comparison.label_changes and not comparison.notes
    assert {f.name for f in comparison.fields} == set(FIELDS)
    assert all(f.difference == 0 for f in comparison.fields)
    assert compare_runs(run, again, Tolerances()).to_plain()["equal"] is True


def test_a_missing_frame_is_caught_and_can_be_tolerated(run: Run, weights: Path, tmp_path: Path) -> None:
    fewer, _ = replayed(weights, tiny_frames()[:-1], tmp_path / "fewer")
    comparison = compare_runs(run, fewer, Tolerances())
    assert differing(comparison) >= {"frames_published", "frames_mapped", "frames_scored"}
    assert {"frames_refused", "frames_dropped", "refused_alone", "voxel_size_m"}.isdisjoint(differing(comparison))
    assert "bits" in differing(compare_runs(run, fewer, Tolerances(), exact=True))
    one = dict.fromkeys(("frames_published", "frames_mapped", "frames_scored"), 1)
    loose = {name: ANY for name in FIELDS if name not in (*one, "bits")}
    assert compare_runs(run, fewer, Tolerances(**one, **loose)).equal


def test_another_refused_frame_is_caught_though_as_many_were_refused(weights: Path, tmp_path: Path) -> None:
    runs = []
    for lost in (2, 3):
        frames = list(tiny_frames())
        frames[lost] = replace(frames[lost], T_world_camera=np.full((4, 4), np.nan))
        runs.append(replayed(weights, frames, tmp_path / str(lost))[0])
    comparison = compare_runs(*runs, Tolerances())
    assert "refused_alone" in differing(comparison) and "frames_refused" not in differing(comparison)
    assert next(f for f in comparison.fields if f.name == "refused_alone").difference == 2
    assert "refused_alone" not in differing(compare_runs(*runs, Tolerances(refused_alone=2)))


@pytest.mark.parametrize("name", [n for n, kind in FIELDS.items() if kind.path])
def test_each_figure_of_the_summary_is_compared_by_itself(run: Run, name: str) -> None:
    assert run.summary is not None
    summary = copy.deepcopy(dict(run.summary))
    section, key = FIELDS[name].path.split(".")
    by = 2 if FIELDS[name].unit == "count" else 0.05
    summary[section][key] += by
    other = replace(run, summary=summary)
    assert differing(compare_runs(run, other, Tolerances())) == {name}
    assert differing(compare_runs(other, run, Tolerances(**{name: by * 0.9}))) == {name}
    assert compare_runs(run, other, Tolerances(**{name: by * 1.1})).equal
    summary[section][key] = None
    assert differing(compare_runs(run, other, Tolerances(**{name: 1e9}))) == {name}, "a figure that is gone differs"
    assert compare_runs(run, other, Tolerances(**{name: ANY})).equal


def test_the_class_whose_score_differs_most_is_named(run: Run) -> None:
    assert run.summary is not None
    summary = copy.deepcopy(dict(run.summary))
    scores = summary["metrics"]["per_class"]
    first, second = list(scores)[:2]
    scores[first] += 0.03
    scores[second] += 0.2
    comparison = compare_runs(run, replace(run, summary=summary), Tolerances())
    field = next(f for f in comparison.fields if f.name == "class_iou")
    assert differing(comparison) == {"class_iou"} and field.detail == second
    assert field.difference == pytest.approx(0.2)
    assert compare_runs(run, replace(run, summary=summary), Tolerances(class_iou=0.21)).equal


def test_other_settings_and_logs_are_told_in_notes(run: Run, weights: Path, tmp_path: Path) -> None:
    other, _ = replayed(weights, tiny_frames(), tmp_path / "other", tiny_config(keyframes={"source_views": 2}))
    assert "config keyframes.source_views: 8 and 2" in compare_runs(run, other, Tolerances()).notes
    notes = compare_runs(run, Run("map.npz", other.voxel_map, None), Tolerances()).notes
    assert notes == ("map.npz is a map alone: frames and metrics are not compared",)


def test_a_moved_wall_is_as_far_as_it_was_moved() -> None:
    comparison = compare_maps(wall(1.0), wall(1.012))
    found = {f.name: f for f in comparison.fields}
    assert found["surface_median_m"].difference == pytest.approx(0.012, abs=5e-4)
    assert differing(comparison) >= {"surface_median_m", "surface_p95_m"}
    assert {"labels", "confidence", "frames_mapped"}.isdisjoint(differing(comparison))
    # Farther away, the view is wider: the new wall has an edge that the old one lacks.
    allowed = Tolerances(surface_median_m=0.0125, surface_p95_m=0.03, blocks=ANY, surface_alone=0.1)
    assert compare_runs(alone(wall(1.0)), alone(wall(1.012)), allowed).equal


def test_distances_are_those_of_brute_force_both_ways() -> None:
    a, b = wall(1.0), wall(1.03, cut=40)
    for mine, points, others in zip(
        match_surfaces(a, b), (a.points(), b.points()), (b.points(), a.points()), strict=True
    ):
        apart = np.linalg.norm(points.xyz[:, None].astype(float) - others.xyz[None], axis=2)
        np.testing.assert_allclose(mine.distance_m, apart.min(axis=1), rtol=1e-6)
        assert (mine.common == (apart.min(axis=1) <= VOXEL_M)).all()


def test_a_missing_part_is_caught_as_surface_and_blocks_of_one_alone() -> None:
    comparison = compare_maps(wall(), wall(cut=40))
    found = {f.name: f for f in comparison.fields}
    assert found["surface_alone"].a == pytest.approx(0.25, abs=0.03) and found["surface_alone"].b == 0
    assert found["surface_median_m"].difference == 0, "the median does not see a quarter"
    assert comparison.blocks is not None and len(comparison.blocks.only_b) == 0
    assert found["blocks"].a == pytest.approx(len(comparison.blocks.only_a) / wall().block_count)
    assert differing(comparison) == {"surface_alone", "blocks", "surface_p95_m"}
    assert compare_maps(wall(), wall(cut=40), surface_alone=0.3, blocks=0.3, surface_p95_m=1).equal


def test_other_classes_are_counted_and_named() -> None:
    comparison = compare_maps(wall(channel=0), wall(channel=0, other=1))
    found = {f.name: f for f in comparison.fields}
    assert differing(comparison) == {"labels"}
    assert found["labels"].difference == pytest.approx(0.5, abs=0.02)
    (mine, theirs, count), *rest = comparison.label_changes
    assert (mine, theirs) == ("table", "cup") and not rest
    assert count / len(wall().points().xyz) == pytest.approx(found["labels"].a, abs=1e-9)
    assert compare_maps(wall(channel=0), wall(channel=0, other=1), labels=0.52).equal


def test_classes_are_compared_by_name_whatever_their_ids() -> None:
    turned = make_label_set("turned", ("wall", "cup", "table"), ids=(1, 2, 3), ignore_id=255)
    same = compare_maps(wall(channel=0), wall(channel=2, labels=turned))
    assert same.equal and not same.label_changes
    renamed = make_label_set("renamed", ("desk", "cup", "wall"), ids=LABELS.ids)
    other = compare_maps(wall(channel=0), wall(channel=0, labels=renamed))
    assert differing(other) == {"labels", "classes"}
    assert next(f for f in other.fields if f.name == "classes").difference == 2
    assert other.label_changes[0][:2] == ("table", "desk")


def test_what_nothing_voted_for_is_unknown_and_no_class() -> None:
    silent = small_map(voxel_size_m=VOXEL_M)
    voted = wall()
    frame_depth = np.full((120, 160), 1.0, np.float32)
    from tests.mapping.rendered_views import frame

    silent.integrate(frame(rgb=128), frame_depth, None)
    comparison = compare_maps(voted, silent)
    assert comparison.label_changes[0][:2] == ("table", "unknown")
    assert differing(comparison) == {"labels", "confidence"}


def test_other_confidence_is_caught() -> None:
    sure, unsure = wall(p=0.9), wall(p=0.6)
    comparison = compare_maps(sure, unsure)
    expected = abs(sure.points().confidence.mean() - unsure.points().confidence.mean())
    assert differing(comparison) == {"confidence"}
    field = next(f for f in comparison.fields if f.name == "confidence")
    assert field.difference == pytest.approx(float(expected), rel=1e-3) and expected > 0.1
    assert compare_maps(sure, unsure, confidence=0.5).equal


def test_one_bit_is_caught_by_the_exact_comparison_alone() -> None:
    once, bright = wall(), wall()
    with bright.locked() as grid:
        grid.buffers().color[0, 7, 1] = np.nextafter(grid.buffers().color[0, 7, 1], np.float32(1e9))
    assert compare_maps(once, bright).equal
    exact = compare_runs(alone(once), alone(bright), Tolerances(), exact=True)
    assert differing(exact) == {"bits"} and exact.fields[-1].difference == 1
    assert compare_runs(alone(once), alone(wall()), Tolerances(), exact=True).equal


def test_evidence_of_another_kind_is_other_bits() -> None:
    packed = wall(evidence="int16")  # type: ignore[arg-type]
    exact = compare_runs(alone(wall()), alone(packed), Tolerances(), exact=True)
    assert exact.fields[-1].difference == packed.block_count


def test_maps_of_other_voxels_still_have_a_surface_to_compare() -> None:
    comparison = compare_maps(wall(), wall(voxel_size_m=0.025))
    assert "voxel_size_m" in differing(comparison) and "blocks" not in {f.name for f in comparison.fields}
    assert any("voxels of other sizes" in note for note in comparison.notes)
    assert {"surface_alone", "labels"}.isdisjoint(differing(comparison))
    draw_comparison(comparison)


def test_empty_maps_are_equal_and_an_empty_one_is_not_a_full_one() -> None:
    empty = small_map(voxel_size_m=VOXEL_M)
    assert compare_maps(empty, small_map(voxel_size_m=VOXEL_M)).equal
    for pair in ((empty, wall()), (wall(), empty)):
        comparison = compare_maps(*pair)
        assert differing(comparison) >= {
            "surface_median_m",
            "surface_p95_m",
            "surface_alone",
            "blocks",
            "frames_mapped",
        }
        assert comparison.to_plain()["fields"]["surface_median_m"]["difference"] is None
        draw_comparison(comparison)


def test_a_comparison_says_the_same_from_both_sides() -> None:
    a, b = wall(1.0, other=1), wall(1.012, cut=30)
    there, back = compare_maps(a, b), compare_maps(b, a)
    for mine, theirs in zip(there.fields, back.fields, strict=True):
        assert (mine.name, mine.a, mine.b, mine.difference) == (theirs.name, theirs.b, theirs.a, theirs.difference)


def test_unknown_fields_and_impossible_tolerances_are_named() -> None:
    with pytest.raises(ConfigError, match="did you mean `labels`"):
        convert_config({"label": 0.1}, Tolerances, "t.toml")
    for value in (-0.1, float("nan"), "much"):
        with pytest.raises(ConfigError, match="labels"):
            convert_config({"labels": value}, Tolerances, "t.toml")
    assert set(Tolerances.__struct_fields__) | {"bits"} == set(FIELDS)


def test_folders_without_a_run_are_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such map file"):
        read_run(tmp_path)
    wall().save(tmp_path / "map.npz")
    assert read_run(tmp_path).summary is None, "a map alone"
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(ConfigError, match="is not the summary of a replay"):
        read_run(tmp_path)
    assert read_run(tmp_path / "map.npz").summary is None


def count(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - color).max(axis=-1) <= 2).sum())


def test_the_picture_shows_where_maps_differ_and_nothing_where_they_do_not() -> None:
    same = draw_comparison(compare_maps(wall(), wall()))
    plans = slice(100, 900), slice(0, 1060)
    assert count(same[plans], RELABELLED) == count(same[plans], ONLY_A) == 0
    assert count(draw_comparison(compare_maps(wall(), wall(other=1))), RELABELLED) > 200
    missing = draw_comparison(compare_maps(wall(), wall(cut=40)))
    assert count(missing[plans], ONLY_A) > 200 and count(missing, RELABELLED) == 0
    assert missing.shape[1] == 1600 and missing.dtype == np.uint8


def test_both_maps_are_drawn_from_one_camera_at_one_scale() -> None:
    picture = draw_comparison(compare_maps(wall(), wall(cut=60)))
    top = HEADER + CAPTION
    panels = [picture[top : top + PANEL_HEIGHT, x : x + COLUMN] for x in (MARGIN, MARGIN + COLUMN + GAP)]
    whole, part = ((np.abs(panel.astype(int) - PANEL).max(axis=-1) > 20) for panel in panels)
    assert 0.2 < part.sum() / whole.sum() < 0.9
    assert (part & whole).sum() > 0.97 * part.sum(), "what both have stands at one place of both panels"


def test_the_texts_of_the_picture_do_not_overlap(run: Run) -> None:
    long = replace(run, name="a folder with a very long name " * 20)
    for comparison in (
        compare_maps(wall(1.0, other=1), wall(1.4, cut=40)),
        compare_runs(run, alone(wall()), Tolerances(), exact=True),
        compare_runs(long, run, Tolerances()),
    ):
        assert not misplaced_texts(figure_of(draw_comparison, comparison))
