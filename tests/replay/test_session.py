import json
import pickle
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from semantic_mapper.config import MapperConfig, convert_config
from semantic_mapper.errors import LabelError
from semantic_mapper.evaluation.metrics import confusion_of
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.fields.weights import anchor_from_frame
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import NYU40, ROOMS, make_label_set
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay import artifacts
from semantic_mapper.replay.artifacts import finish_session
from semantic_mapper.replay.evaluate.methods import MAP, Opinion, baseline_predictors, evaluate_frames, field_predictors
from semantic_mapper.replay.evaluate.truth import SurfaceTruth, TruthMapper
from semantic_mapper.replay.session import SHORTEST_MS, LatencyHistogram, MapSession, open_recording
from semantic_mapper.replay.summary import notes, summary_table
from semantic_mapper.types import MapUpdate, PosedFrame
from tests.mapping.test_segmenter import TABLE, painted, write_model
from tests.small import tiny_config, tiny_field, tiny_frames


@pytest.fixture
def weights(tmp_path):
    """Untrained weights that claim to be finetuned on frame 1."""
    frames = tiny_frames()
    recipe = {"kind": "finetune", "width": 96, "train_stamps_ns": [frames[1].stamp_ns]}
    save_checkpoint(Checkpoint(tiny_field(), (anchor_from_frame(frames[1], 96),), recipe), tmp_path / "w.safetensors")
    return tmp_path / "w.safetensors"


def run(weights, frames, rerun=None, depth="auto", moving=None, **options):
    mapper = Mapper.load(weights, tiny_config(depth={"source": depth}, moving=moving or {}))
    recording = open_recording(rerun, mapper.pipeline)
    session = MapSession(mapper, stream_labels=ROOMS, source="test", rerun=recording, **options)
    for frame in frames:
        session.process(frame)
    return session


def test_a_session_leaves_summary_map_points_and_picture(tmp_path, weights):
    session = run(weights, tiny_frames(), rerun=tmp_path / "run.rrd")
    summary = finish_session(session, tmp_path / "out")
    on_disk = json.loads((tmp_path / "out/summary.json").read_text())
    assert on_disk == summary
    assert summary["frames"]["published"] == summary["frames"]["fused"] == 6
    assert summary["frames"]["dropped"] == 0
    assert summary["labels"]["1"] == "wall" and summary["weights"]["file"] == "w.safetensors"
    points = VoxelMap.load(tmp_path / "out/map.npz").points()
    assert len(points.xyz) == summary["map"]["surface_points"]
    unknown = (points.label == session.pipeline.label_set.ignore_id).mean()
    assert summary["map"]["unknown"] == pytest.approx(unknown, abs=1e-4)
    assert cv2.imread(str(tmp_path / "out/overview.png")).std() > 10
    assert (tmp_path / "run.rrd").read_bytes()[:4] in (b"RRF2", b"RRIO", b"RRF3") and (
        tmp_path / "run.rrd"
    ).stat().st_size > 10_000


def test_a_map_whose_memory_of_objects_is_damaged_is_saved_all_the_same(tmp_path, weights):
    session = run(weights, tiny_frames())
    session.pipeline.voxel_map.objects = b"no memory"
    with capture_logs() as told:
        finish_session(session, tmp_path)
    assert VoxelMap.load(tmp_path / "map.npz").frames == len(tiny_frames())
    assert "objects_not_remembered" in [line["event"] for line in told]


def test_the_summary_has_the_settings_that_were_in_force(tmp_path, weights):
    config = tiny_config(quality="fast", render={"scale": 0.5})
    session = MapSession(Mapper.load(weights, config), stream_labels=None)
    summary = finish_session(session, tmp_path / "out")
    assert summary["quality"] == "fast"
    assert (summary["config"]["sampling"]["guided"], summary["config"]["render"]["ray_fraction"]) == (2, 0.12)
    assert summary["config"]["render"]["encode_width"] == 96, "that of the weights"
    again = convert_config(summary["config"], MapperConfig, "summary")
    assert again == session.pipeline.config and again.voxel_map == config.voxel_map


@pytest.fixture
def subtitles(monkeypatch):
    """Those of the pictures that are drawn; nothing else is."""
    said: list[str] = []

    def draw(*_, subtitle, **__):
        said.append(subtitle)
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr(artifacts, "draw_overview", draw)
    return said


@pytest.mark.parametrize(
    ("depth", "measured", "source", "row"),
    [
        ("auto", 6, "sensor", "sensor"),
        ("sensor", 3, "mixed", "rendered by the field for 50.0 % of the frames"),
        ("auto", 0, "computed", "computed from the pictures for 100.0 % of the frames"),
    ],
)
def test_summary_table_notes_and_picture_say_where_depth_comes_from(
    tmp_path, weights, subtitles, depth, measured, source, row
):
    frames = tiny_frames()
    given = [*frames[:measured], *(replace(f, depth_m=None) for f in frames[measured:])]
    summary = finish_session(run(weights, given, depth=depth), tmp_path / "out")
    without, computed, said = 1 - measured / 6, depth == "auto", summary["depth"]
    assert said["source"] == source
    assert (said["rendered_fraction"], said["computed_fraction"]) == ((0, without) if computed else (without, 0))
    table = summary_table({"run": summary})
    cells = dict(zip(*(column.cells for column in table.columns), strict=True))
    assert cells["depth"] == row and (row in subtitles[0]) == (measured < 6)
    assert any(row.split(" for ")[0] in note for note in notes(summary)) == (measured < 6)
    points = VoxelMap.load(tmp_path / "out/map.npz").points()
    fraction = 1 - points.measured.mean() if len(points.xyz) else None
    assert summary["map"]["computed"] == (None if fraction is None else pytest.approx(fraction, abs=1e-4))


def test_moving_classes_that_no_depth_sensor_serves_are_in_log_status_and_summary(tmp_path, weights):
    frames = tiny_frames(3)
    films = [replace(f, depth_m=None) for f in frames[1:]]
    for stream, on, said in (((frames[0], *films), True, "2 frames"), (films, False, ""), (frames, True, "")):
        with capture_logs() as logs:
            session = run(weights, stream, moving={"classes": on})
        assert [line["event"] for line in logs].count("moving_classes_stay") == bool(said)
        (warning,) = [w for w in session.warnings if "moving.classes" in w] if said else session.warnings[-1:]
        summary = finish_session(session, tmp_path)
        assert said in warning and bool(warning) == bool(said)
        assert summary["map"]["moving_warning"] == (warning or None)
        assert any("moving.classes" in note for note in notes(summary)) == bool(said)


def test_a_nearly_empty_map_is_plainly_said_so_with_the_reason(tmp_path, weights, subtitles, monkeypatch):
    monkeypatch.setattr(artifacts, "MIN_POINTS_A_BLOCK", 1000)
    frames = tiny_frames()
    without = [replace(f, depth_m=None) for f in frames]
    far = [replace(f, depth_m=f.depth_m + np.float32(5.1) * (f.depth_m > 0)) for f in frames]
    limit = [
        replace(f, depth_m=np.full_like(f.depth_m, 7.5), depth_sigma_m=np.full_like(f.depth_m, 0.1)) for f in frames
    ]
    for depth, frames_in, why in (
        ("sensor", without, "have no sensor depth, and depth that the field renders"),
        ("auto", without, "needs exact poses"),
        ("auto", frames, "check depth_scale, the intrinsics and the poses"),
        ("auto", far, "in 6 of 6 frames most of the depth is beyond the range of the map"),
        ("auto", limit, "in 6 of 6 frames most of the computed depth is beyond 5 m, where the range"),
    ):
        summary = finish_session(run(weights, frames_in, depth=depth), tmp_path)
        said = summary["map"]["nearly_empty"]
        assert said.startswith("the map is nearly empty: ") and why in said
        assert f"warning: {said}" in notes(summary) and "MAP NEARLY EMPTY" in subtitles[-1]
        assert summary["depth"]["computed_too_far"] == (frames_in is limit)
        assert (
            ("OUT OF RANGE" in subtitles[-1]) == (frames_in in (far, limit)) == bool(summary["depth"]["range_warning"])
        )
        assert any("(nearly empty)" in cell for cell in summary_table({"run": summary}).columns[1]._cells)
    nothing = finish_session(MapSession(Mapper.load(weights, tiny_config()), stream_labels=ROOMS), tmp_path)
    assert nothing["frames"]["fused"] == 0 and nothing["latency_ms"]["p50"] is None
    assert all(v is None for v in nothing["metrics"].values()) and nothing["metrics_per_image"] is None


def test_poses_that_contradict_the_depth_are_in_summary_table_picture_and_notes(tmp_path, weights, subtitles):
    right = finish_session(run(weights, tiny_frames(30)), tmp_path / "right")
    assert right["pose_check"]["warning"] is None and right["pose_check"]["depth_disagreement"] < 0.01
    wrong_poses = [replace(f, T_world_camera=invert_pose(f.T_world_camera)) for f in tiny_frames(30)]
    wrong = finish_session(run(weights, wrong_poses), tmp_path / "wrong")
    assert "poses inverted" in wrong["pose_check"]["warning"] and "poses inverted" in notes(wrong)[0]
    assert right["pose_check"]["worst_contradicting_pairs"] == 0 and not any(
        "inverted" in note for note in notes(right)
    )
    assert wrong["pose_check"]["worst_depth_disagreement"] >= wrong["pose_check"]["depth_disagreement"] > 0.02
    assert ["POSES CANNOT BE TRUSTED" in subtitle for subtitle in subtitles] == [False, True]
    few = finish_session(run(weights, tiny_frames(30)[:2]), tmp_path / "few")
    table = summary_table({"right": right, "wrong": wrong, "few": few})
    names, *values = (list(column.cells) for column in table.columns)
    first, second, third = (column[names.index("depth disagreement")] for column in values)
    assert third == values[2][names.index("contradicting pairs")] == "not checked"
    assert float(first.removesuffix(" %")) < 1 and float(second.removesuffix(" %")) > 2


def test_scores_are_those_of_the_rendered_labels(weights):
    frames = tiny_frames()
    session = MapSession(Mapper.load(weights, tiny_config()), stream_labels=ROOMS)
    right = counted = 0
    for frame in frames:
        (update,) = session.process(frame)
        assert isinstance(update, MapUpdate)
        if frame.stamp_ns != frames[1].stamp_ns:
            labelled = frame.label != ROOMS.ignore_id
            right += int((update.label == frame.label)[labelled].sum())
            counted += int(labelled.sum())
    assert np.isclose(session.confusion.metrics().total_accuracy, right / counted)
    assert session.excluded == 1 and session.scored == 5


def test_refused_frames_are_counted_with_their_reason_and_the_rest_is_mapped(tmp_path, weights):
    frames = list(tiny_frames())
    broken = frames[2].T_world_camera.copy()
    broken[1, 1] = np.inf
    frames[2] = replace(frames[2], T_world_camera=broken)
    session = run(weights, frames)
    session.refuse(9, 0, "message 9: checksum is wrong")
    session.count_dropped(3)
    received = session.received
    session.refuse_unreadable(3, ("a.mcap: frame 1 at byte 9: damaged",))
    assert session.received == received, "a player could not read them; they are not missed"
    summary = finish_session(session, tmp_path / "out")
    assert (summary["frames"]["published"], summary["frames"]["fused"]) == (13, 5)
    assert (summary["frames"]["refused"], summary["frames"]["dropped"]) == (5, 3)
    assert any("seq=2" in r["reason"] and "NaN or infinity" in r["reason"] for r in summary["refusals"])


def test_a_session_of_days_keeps_count_in_memory_that_does_not_grow(tmp_path, weights):
    """A camera that sends every second frame without a usable pose, for as long as it takes."""
    frames = tiny_frames()
    lost = replace(frames[2], T_world_camera=np.full((4, 4), np.nan))
    session = run(weights, frames)
    for n in range(500):  # a step beside what is counted would take too long for as many
        session.process(replace(lost, seq=6 + n))
        session.refuse(6 + n, 0, "message: checksum is wrong")
        session.note_damage(f"at {n}")
    before = len(pickle.dumps((session.refusals, session.damages, session.step_ms, session.stage_ms)))
    for n in range(500, 1500):
        session.process(replace(lost, seq=6 + n))
        session.note_damage(f"at {n}")
        session.step_ms.add(10.0 + n)
        session.per_image.add(confusion_of(frames[0].label, frames[0].label, ROOMS))
    grown = len(pickle.dumps((session.refusals, session.damages, session.step_ms, session.stage_ms))) - before
    assert abs(grown) < 2000
    summary = finish_session(session, tmp_path / "out")
    assert summary["frames"]["refused"] == 2000 and summary["frames"]["published"] == 2006
    assert [r["seq"] for r in summary["refusals"]] == [6 + n // 2 for n in range(50)]
    assert summary["damaged_stretches"] == [f"at {n}" for n in range(50)]
    assert summary["latency_ms"]["p95"] == pytest.approx(1459, rel=0.005)
    assert summary["metrics_per_image"]["miou"] > 0.95, "of some thousand images, all but five right"


@pytest.mark.parametrize("bad", [0, 1, 2])  # 1 is a frame that the weights were finetuned on
def test_an_unknown_label_id_costs_the_score_but_neither_map_nor_results(tmp_path, weights, bad):
    frames = list(tiny_frames(3))
    label = frames[bad].label.copy()
    label[0, 0] = 77
    frames[bad] = replace(frames[bad], label=label)
    session = run(weights, frames)
    assert session.fused == 3 and session.scored == (2 if bad == 1 else 1)
    summary = finish_session(session, tmp_path / "out")
    assert summary["frames"]["labels_refused"] == 1 and summary["frames"]["refused"] == 0
    assert "77" in summary["refusals"][0]["reason"] and f"seq={bad}" in summary["refusals"][0]["reason"]
    assert (tmp_path / "out/overview.png").exists()


def test_truth_is_translated_by_class_name():
    mapper = TruthMapper(NYU40, ROOMS)
    label = np.array([[1, 5, 37]], np.uint8)  # wall, chair, bag
    translated = mapper.to_map_ids(label, "frame")
    assert translated.tolist() == [[ROOMS.ids[0], ROOMS.ids[ROOMS.names.index("chair")], ROOMS.ignore_id]]
    with pytest.raises(LabelError, match="99"):
        mapper.to_map_ids(np.array([[99]], np.uint8), "frame")


def test_surface_truth_is_the_majority_of_the_frames_that_see_the_point():
    frame = tiny_frames()[0]
    truth = SurfaceTruth(ROOMS)
    wall, floor = np.full_like(frame.label, ROOMS.ids[0]), np.full_like(frame.label, ROOMS.ids[1])
    for label in (wall, floor, wall):
        truth.add(replace(frame, label=label))
    k, z = frame.intrinsics, frame.depth_m[36, 48]
    seen = np.array([(48 - k.cx) / k.fx * z, (36 - k.cy) / k.fy * z, z, 1]) @ frame.T_world_camera.T
    behind = frame.T_world_camera[:3, 3] - frame.T_world_camera[:3, 2]
    labels = truth.labels_at(np.stack((seen[:3], behind)).astype(np.float32))
    assert labels.tolist() == [ROOMS.ids[0], ROOMS.ignore_id]


def test_methods_are_scored_on_the_same_frames_and_keyframes_never_count(weights):
    frames = list(tiny_frames())
    mapper = Mapper.load(weights, tiny_config())
    keyframes = [frames[1], frames[4]]
    predictors = field_predictors(mapper) | baseline_predictors(keyframes, ROOMS, seconds=1.0, seed=0)
    excluded = frozenset(f.stamp_ns for f in keyframes)
    result = evaluate_frames(frames, predictors, ROOMS, ROOMS, excluded)
    own = {"sray", "sray, novel view", "own image alone"}
    assert set(result.methods) == own | {"per-image U-Net", "labels carried by depth"}
    for name, figures in result.methods.items():
        assert (figures["ece"] is not None) is (name in own) and figures["open_set_auroc"] is None
    assert (result.scored, result.excluded, result.refused) == (4, 2, 0)
    assert len({m["pixels"] for m in result.methods.values()}) == 1
    assert result.methods["labels carried by depth"]["total_accuracy"] > 0.5


def test_no_segmenter_sees_the_frame_of_a_novel_view(weights, tmp_path):
    table = TABLE.replace("miss = 0.4", "miss = 0.01").replace("0.1", "0.0001")
    segmenter = {"table": str(write_model(tmp_path, table)), "every_n_frames": 1}
    moving = {"motion": False, "classes": True}
    with_it = field_predictors(Mapper.load(weights, tiny_config(segmenter=segmenter, moving=moving)))
    without = field_predictors(Mapper.load(weights, tiny_config(moving={"motion": False})))
    for frame in map(painted, tiny_frames(3)):
        for name in ("sray", "sray, novel view"):
            label, plain = with_it[name](frame).label, without[name](frame).label
            assert np.array_equal(label, plain) is (name != "sray"), name


def test_an_unknown_label_costs_one_frame_of_an_evaluation_and_progress_still_ends():
    frames = list(tiny_frames(3))
    label = frames[1].label.copy()
    label[0, 0] = 77
    frames[1] = replace(frames[1], label=label)
    seen: list[int] = []
    result = evaluate_frames(frames, {"truth": lambda f: Opinion(f.label)}, ROOMS, ROOMS, frozenset(), seen.append)
    assert (result.scored, result.refused) == (2, 1) and seen == [1, 2, 3]
    assert result.methods["truth"]["miou"] == 1.0


def test_the_map_is_scored_at_its_points_beside_the_frames():
    stream = make_label_set("mine", ["wall", "spaceship"], ids=[1, 9])
    frames = [replace(f, label=np.where(f.label == ROOMS.ids[0], 1, 9).astype(np.uint8)) for f in tiny_frames(3)]
    voxel_map = VoxelMap(tiny_config(voxel_map={"voxel_size_m": 0.05, "unknown_below": 0.65}).voxel_map, ROOMS)

    def fuse(frame: PosedFrame) -> Opinion:
        """Walls for sure; spaceships are taken for floor, without conviction."""
        wall = frame.label == 1
        probabilities = np.full((*wall.shape, len(ROOMS)), 0.01, np.float32)
        probabilities[..., 0], probabilities[..., 1] = np.where(wall, 0.8, 0.2), np.where(wall, 0.01, 0.41)
        voxel_map.integrate(frame, frame.depth_m, probabilities / probabilities.sum(-1, keepdims=True))
        return Opinion(frame.label)

    held_back = frozenset((frames[2].stamp_ns,))
    result = evaluate_frames(frames, {"fused": fuse}, stream, ROOMS, held_back, voxel_map=voxel_map)
    figures = result.methods[MAP]
    assert set(figures["per_class"]) == {"wall"} and figures["total_accuracy"] > 0.95
    assert figures["open_set_auroc"] > 0.95 and 0.05 < figures["ece"] < 0.25
    assert 0.9 < figures["open_set_unknown"] < 1.0, "all but what mixes with walls at the border"
    assert 0 < figures["pixels"] < len(voxel_map.points().xyz)
    voxel_map.config = msgspec.structs.replace(voxel_map.config, unknown_below=1.0)
    unsure = evaluate_frames(frames, {"": lambda f: Opinion(f.label)}, stream, ROOMS, held_back, voxel_map=voxel_map)
    assert unsure.methods[MAP]["ece"] == figures["ece"], "confidence is that of the likeliest class, unknown or not"
    assert unsure.methods[MAP]["open_set_unknown"] == 1.0 and unsure.methods[MAP]["total_accuracy"] == 0
    assert MAP not in evaluate_frames(frames, {"fused": fuse}, stream, ROOMS, frozenset()).methods


@given(st.lists(st.floats(SHORTEST_MS, 1e7), max_size=60), st.sampled_from([0.0, 50.0, 95.0, 100.0]))
def test_percentiles_are_those_of_all_steps_but_the_first(values, percent):
    times = LatencyHistogram()
    for value in values:
        times.add(value)
    if not values:
        assert times.first is None and times.percentile(percent) is None
        return
    assert times.first == values[0]
    expected = np.percentile(values[1:] or values, percent, method="nearest")
    assert times.percentile(percent) == pytest.approx(expected, rel=0.0026)
