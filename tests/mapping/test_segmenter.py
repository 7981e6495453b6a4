"""A small model in ONNX, written here: every pixel's class is that of its red, green or blue."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from semantic_mapper.config import SegmenterConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import FrameViews
from semantic_mapper.labels import KLEVR, ROOMS
from semantic_mapper.mapping.rendering import RenderedView
from semantic_mapper.mapping.segmenter import Segmenter
from semantic_mapper.types import Float32, PosedFrame
from tests.small import INTRINSICS, tiny_frames, tiny_pipeline

COARSE = scale_intrinsics(INTRINSICS, 48, 36)
GAIN = 0.2  # of the input, logits from colours
TABLE = """
model = "model.onnx"
width = 96
classes = ["none", "seat", "walker"]
moving = ["walker"]
miss = 0.4
false_alarm = 0.1
names = { seat = "chair", walker = "person" }
"""


def write_model(folder: Path, table: str = TABLE, size: tuple[int, int] | None = None, *, last: bool = False) -> Path:
    """A model of any size, or of one, of pictures (3, H, W) or (H, W, 3), and its table."""
    weight = GAIN * np.eye(3, dtype=np.float32)[:, :, None, None]
    nodes = [helper.make_node("Conv", ["x", "weight"], ["y"])]
    shape: list[int | str] = [*size] if size else ["h", "w"]
    taken = given = [1, 3, *shape]
    if last:
        taken = given = [1, *shape, 3]
        nodes.insert(0, helper.make_node("Transpose", ["picture"], ["x"], perm=(0, 3, 1, 2)))
        nodes.append(helper.make_node("Transpose", ["y"], ["out"], perm=(0, 2, 3, 1)))
    names = ("picture", "out") if last else ("x", "y")
    values = [
        helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, s) for n, s in zip(names, (taken, given), strict=True)
    ]
    graph = helper.make_graph(nodes, "m", values[:1], values[1:], [numpy_helper.from_array(weight, "weight")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, folder / "model.onnx")
    (folder / "table.toml").write_text(table)
    return folder / "table.toml"


def painted(frame: PosedFrame) -> PosedFrame:
    """Red on the left, green in the middle, blue on the right."""
    rgb = np.zeros_like(frame.rgb)
    for channel in range(3):
        rgb[:, 32 * channel : 32 * channel + 32, channel] = 255
    return replace(frame, rgb=rgb)


def flat_view() -> RenderedView:
    size = COARSE.height, COARSE.width
    even = np.full((*size, len(ROOMS)), 1 / len(ROOMS), np.float32)
    return RenderedView(even, np.ones(size, np.bool_), np.ones(size, np.float32))


@pytest.mark.parametrize(("size", "last"), [(None, False), ((72, 96), False), ((40, 64), True), (None, True)])
def test_probabilities_are_joined_by_bayes_rule(tmp_path: Path, size: tuple[int, int] | None, last: bool):
    segmenter = Segmenter(SegmenterConfig(table=str(write_model(tmp_path, size=size, last=last))), ROOMS)
    opinion = segmenter.look(FrameViews(painted(tiny_frames()[0])), COARSE)
    joint = opinion.join(flat_view()).probabilities
    assert np.allclose(joint.sum(axis=2), 1, atol=1e-5)
    chair, person, wall = (ROOMS.names.index(n) for n in ("chair", "person", "wall"))
    n = len(ROOMS) - 2  # classes that the model lacks
    for column, (of_chair, of_person, of_wall) in zip(
        (8, 24, 40), ((0.4, 0.4, 0.9), (0.6, 0.1, 0.1), (0.1, 0.6, 0.1)), strict=True
    ):
        total = of_chair + of_person + n * of_wall
        expected = np.array((of_chair, of_person, of_wall)) / total
        assert joint[18, column, [chair, person, wall]] == pytest.approx(expected, abs=1e-4)
    assert opinion.moving[:, 36:].all() and not opinion.moving[:, :28].any()


def test_weight_and_temperature_and_channels_are_of_the_table(tmp_path: Path):
    views = FrameViews(painted(tiny_frames()[0]))

    def at(more: str) -> Float32:
        table = more + TABLE
        opinion = Segmenter(SegmenterConfig(table=str(write_model(tmp_path, table))), ROOMS).look(views, COARSE)
        return opinion.join(flat_view()).probabilities[18, :, ROOMS.names.index("chair")]

    assert np.allclose(at("weight = 0.0\n"), 1 / len(ROOMS))
    assert at("")[24] > at("weight = 0.5\n")[24] > 1.5 / len(ROOMS)
    assert at("")[24] > at("temperature = 100.0\n")[24]
    swapped = at('channels = "bgr"\nmean = [1.0, 1.0, 1.0]\nscale = [1.0, 1.0, 1.0]\n')
    assert swapped[24] == pytest.approx(at("")[24], abs=1e-3)  # green stays, and blue is not found now
    assert swapped[40] < 1 / len(ROOMS) == pytest.approx(at("weight = 0.0\n")[40])


def test_frames_between_take_the_answer_over_where_they_see_the_same_surface(tmp_path: Path):
    segmenter = Segmenter(SegmenterConfig(table=str(write_model(tmp_path)), every_n_frames=3), ROOMS)
    first = painted(tiny_frames()[0])
    black = replace(first, rgb=np.zeros_like(first.rgb))
    assert first.depth_m is not None
    shown = segmenter.look(FrameViews(first), COARSE)
    same = segmenter.look(FrameViews(black), COARSE)
    measured = FrameViews(first).depth(COARSE) > 0
    assert measured.mean() > 0.5
    assert np.array_equal(same.likelihood[measured], shown.likelihood[measured])
    assert (same.likelihood[~measured] == 1).all() and not same.moving[~measured].any()
    nearer = segmenter.look(FrameViews(replace(black, depth_m=first.depth_m / 2)), COARSE)
    assert (nearer.likelihood == 1).mean() > 0.95  # another surface
    assert not np.array_equal(segmenter.look(FrameViews(black), COARSE).likelihood, shown.likelihood)  # shown again


def test_it_joins_labels_and_map_and_what_moves_is_left_out(tmp_path: Path):
    frame = painted(tiny_frames()[0])
    table = str(write_model(tmp_path, TABLE.replace("miss = 0.4", "miss = 0.01").replace("0.1", "0.0001")))
    with_it = tiny_pipeline(segmenter={"table": table}, moving={"motion": False, "classes": True})
    update = with_it.step(frame)
    assert "segment" in update.stage_ms and "segment" not in tiny_pipeline().step(frame).stage_ms
    assert (update.label[4:-4, 36:60] == ROOMS.id_of("chair")).mean() > 0.9
    assert update.moving is not None and update.moving[:, 70:].mean() > 0.9 and not update.moving[:, :60].any()
    rendered, voted = with_it.voxel_map.points(), tiny_pipeline(segmenter={"table": table})
    voted.step(frame)
    assert (voted.voxel_map.points().label == ROOMS.id_of("chair")).mean() > 0.2
    assert 0 < len(rendered.xyz) < 0.8 * len(voted.voxel_map.points().xyz)  # without the third that walks


def test_its_answer_counts_in_the_map_whatever_the_own_image_weighs(tmp_path: Path):
    table = str(write_model(tmp_path, TABLE.replace("miss = 0.4", "miss = 0.01").replace("0.1", "0.0001")))
    pipeline = tiny_pipeline(segmenter={"table": table}, keyframes={"own_image_weight": 1.0})
    pipeline.step(painted(tiny_frames()[0]))
    assert (pipeline.voxel_map.points().label == ROOMS.id_of("chair")).mean() > 0.2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('model = "model.onnx"', 'model = "modle.onnx"', r"modle\.onnx cannot be read .*did you mean"),
        ('"none", "seat"', '"seat"', "makes .* values a pixel, as many as `classes`"),
        ('moving = ["walker"]', 'moving = ["walkre"]', "has no class 'walkre'; did you mean `walker`"),
        ("width = 96", 'width = 96\nsha256 = "00"', "sha256 is not that of"),
        ("width = 96", "size = 96", "unknown key `size`"),
        ("width = 96", 'width = 96\noutput = "probabilities"', 'do not sum to 1; say "logits"'),
        ('seat = "chair"', 'seat = "chiar"', "no label set has 'chiar'; did you mean `chair`"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(tmp_path: Path, old: str, new: str, message: str):
    path = write_model(tmp_path, TABLE.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        Segmenter(SegmenterConfig(table=str(path)), ROOMS)


def test_each_camera_has_its_own_turn(tmp_path: Path):
    segmenter = Segmenter(SegmenterConfig(table=str(write_model(tmp_path)), every_n_frames=2), ROOMS)
    frame = painted(tiny_frames(1)[0])
    for camera in ("left", "right"):  # in turns, each shown at once
        view = FrameViews(replace(frame, camera_id=camera, depth_m=None))
        joint = segmenter.look(view, COARSE).join(flat_view()).probabilities
        assert np.abs(joint - flat_view().probabilities).max() > 0.05


def test_a_size_of_pictures_that_the_model_does_not_take_is_said(tmp_path: Path):
    path = write_model(tmp_path, TABLE.replace("width = 96", "width = 320"))
    model = onnx.load(tmp_path / "model.onnx")  # which halves pictures six times, and joins both ends
    nodes, scales = model.graph.node, np.array([1, 1, 64, 64], np.float32)
    nodes[0].output[0] = "logits"
    nodes.append(helper.make_node("AveragePool", ["logits"], ["small"], kernel_shape=[64, 64], strides=[64, 64]))
    nodes.append(helper.make_node("Resize", ["small", "", "scales"], ["large"]))
    nodes.append(helper.make_node("Add", ["logits", "large"], ["y"]))
    model.graph.initializer.append(numpy_helper.from_array(scales, "scales"))
    onnx.save(model, tmp_path / "model.onnx")
    segmenter, frame = Segmenter(SegmenterConfig(table=str(path), every_n_frames=1), ROOMS), tiny_frames(1)[0]
    assert segmenter.look(FrameViews(frame), COARSE).moving.shape == (36, 48)
    wide = replace(frame, rgb=frame.rgb[:64], depth_m=None, label=None, intrinsics=replace(INTRINSICS, height=64))
    with pytest.raises(ConfigError, match="takes no picture of 320x224"):
        segmenter.look(FrameViews(wide), COARSE)


def write_export(folder: Path, taken: str, given: str, nodes: str, table: str = TABLE) -> Path:
    """A model whose logits "y" go through some nodes, and its table."""
    logits = f"gain = Constant<value_float = {GAIN}>() y = Mul(x, gain)"
    text = f'<ir_version: 8, opset_import: ["": 17]> m (float[{taken}] x) => ({given}) {{ {logits} {nodes} }}'
    onnx.save(onnx.parser.parse_model(text), folder / "model.onnx")
    (folder / "table.toml").write_text(table)
    return folder / "table.toml"


TWO = "float[n,3,a,b] out, float[n,3,a,b] aux", "out = Identity(y) aux = Neg(y)"
LABELS = "int64[n,1,a,b] labels", "labels = ArgMax<axis = 1>(y)"


@pytest.mark.parametrize("taken", ["n,3,h,w", "n,3,72,96", "1,3,72,96"])
@pytest.mark.parametrize(
    ("given", "nodes", "more"),
    [
        (*TWO, 'output_name = "out"'),
        ("float[n,3,a,b] logits", "logits = AveragePool<kernel_shape = [4, 4], strides = [4, 4]>(y)", ""),
        ("int64[n,a,b] labels", "labels = ArgMax<axis = 1, keepdims = 0>(y)", ""),
        (*LABELS, ""),
    ],
)
def test_usual_exports_are_taken(tmp_path: Path, taken: str, given: str, nodes: str, more: str):
    path = write_export(tmp_path, taken, given, nodes, f"{more}\n{TABLE}")
    opinion = Segmenter(SegmenterConfig(table=str(path)), ROOMS).look(FrameViews(painted(tiny_frames()[0])), COARSE)
    left, middle, right = opinion.join(flat_view()).probabilities[18, [8, 24, 40], ROOMS.names.index("chair")]
    assert middle > 2 * left and middle > 2 * right
    assert opinion.moving[:, 40:].all() and not opinion.moving[:, :28].any()


@pytest.mark.parametrize("more", ["", 'output_name = "uot"'])
def test_outputs_that_are_not_clear_are_said(tmp_path: Path, more: str):
    path = write_export(tmp_path, "n,3,h,w", *TWO, f"{more}\n{TABLE}")
    with pytest.raises(ConfigError, match=r'say `output_name = "out"` in the table, .* out, aux'):
        Segmenter(SegmenterConfig(table=str(path)), ROOMS)


def test_a_class_without_a_name_is_said(tmp_path: Path):
    table = TABLE.replace(', "walker"]', "]").replace("moving", "# ").replace(', walker = "person"', "")
    segmenter = Segmenter(SegmenterConfig(table=str(write_export(tmp_path, "n,3,h,w", *LABELS, table))), ROOMS)
    with pytest.raises(ConfigError, match="gives classes 0 to 2, but 2 are named"):
        segmenter.look(FrameViews(painted(tiny_frames()[0])), COARSE)


def test_files_that_are_no_model_are_refused_and_the_right_digest_is_not(tmp_path: Path):
    path = write_model(tmp_path)
    digest = hashlib.sha256((tmp_path / "model.onnx").read_bytes()).hexdigest()
    path.write_text(f'sha256 = "{digest}"' + TABLE)
    assert Segmenter(SegmenterConfig(table=str(path)), ROOMS).moves
    path.write_text(TABLE.replace('moving = ["walker"]', ""))
    with pytest.raises(ConfigError, match="none of the classes of 'klevr' is among them"):
        Segmenter(SegmenterConfig(table=str(path)), KLEVR)
    (tmp_path / "model.onnx").write_bytes(b"no model")
    with pytest.raises(ConfigError, match=r"model\.onnx is no network"):
        Segmenter(SegmenterConfig(table=str(path)), ROOMS)
    with pytest.raises(ConfigError, match="no such file"):
        tiny_pipeline(segmenter={"table": str(tmp_path / "tabel.toml")})
