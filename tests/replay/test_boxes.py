"""Files of boxes: three formats, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import structlog

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.scene.boxes import PrimitiveSet
from semantic_mapper.fields.scene.primitives import Primitive, resized
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.nodes.map_answers import answer_instances
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.replay.boxes import BoxFile, load_boxes, with_classes, with_times
from semantic_mapper.replay.importers.kitti360 import LABELS
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.messages import StreamInfo
from tests.small import tiny_frames

T = pose_matrix(np.array((1.0, 2.0, 0.5)), np.array((0, 0, 0.3, 0.9)))
CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
QUADS = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])


def entry(**changed: Any) -> dict[str, Any]:
    given = {"id": 1, "class": "chair", "shape": "box", "T_world_box": T.tolist(), "size": [1, 1, 1], "thing": True}
    return {k: v for k, v in (given | changed).items() if v is not None}


def write(path: Path, *entries: dict[str, Any], **rest: Any) -> Path:
    path.write_text(json.dumps({"boxes": list(entries), **rest}))
    return path


def matrix(name: str, values: np.ndarray, kind: str = "f") -> str:
    rows, columns = values.shape
    data = "\n".join(" ".join(map(repr, row)) for row in values.tolist())
    shape = f"<rows>{rows}</rows><cols>{columns}</cols><dt>{kind}</dt>"
    return f"<{name} type_id='opencv-matrix'>{shape}<data>{data}</data></{name}>"


def kitti_xml(*objects: tuple[int, str, int, np.ndarray], instance: int = 0) -> str:
    listed = "".join(
        f"<object{index}><index>{index}</index><label>{label}</label><timestamp>{stamp}</timestamp>"
        f"<instanceId>{instance}</instanceId>"
        f"{matrix('transform', transform)}{matrix('vertices', CORNERS)}{matrix('faces', QUADS, 'i')}</object{index}>"
        for index, label, stamp, transform in objects
    )
    return f"<?xml version='1.0'?><opencv_storage>{listed}</opencv_storage>"


def at(*centre: float) -> np.ndarray:
    pose = np.eye(4)
    pose[: len(centre), 3] = centre
    return pose


def test_all_shapes_are_read(tmp_path: Path) -> None:
    triangles = np.concatenate((QUADS[:, :3], QUADS[:, (0, 2, 3)]))
    entries = [
        entry(),
        entry(id=2, shape="ellipsoid", size=[1, 2, 3], thing=None),
        entry(id=3, shape="prism", size=[9, 9, 2], polygon=[[0, 0], [2, 0], [0, 1]], **{"class": "floor"}, thing=None),
        entry(id=4, shape="mesh", size=None, vertices=CORNERS.tolist(), faces=triangles.tolist()),
        entry(id=5, stamps=[[10, T.tolist()], [20, np.eye(4).tolist()]]),
    ]
    boxes = load_boxes(write(tmp_path / "a.json", *entries, merge={"chair": ["sofa"]}))
    assert [p.thing for p in boxes.primitives] == [True, True, False, True, True]
    assert [p.moves for p in boxes.primitives] == [False, False, False, False, True]
    assert boxes.primitives[2].size.tolist() == [2, 1, 2]
    assert boxes.merge == {"chair": ("sofa",)}


def test_kitti360_xml_is_read_with_its_names_and_scales(tmp_path: Path) -> None:
    scaled = T.copy()
    scaled[:3, :3] *= (4.0, 2.0, 1.5)
    xml = kitti_xml((0, "building", -1, scaled), (1, "driveway", -1, T), (2, "car", 7, T), (3, "unknownObject", -1, T))
    (tmp_path / "drive.xml").write_text(xml)
    boxes = load_boxes(tmp_path / "drive.xml")
    assert boxes.primitives[2].frames and boxes.primitives[2].stamps is None
    assert [(p.id, p.class_name, p.thing, p.moves) for p in boxes.primitives] == [
        (1, "building", True, False),
        (2, "parking", False, False),
        (3, "car", True, True),
    ]
    assert boxes.left_out == 1
    building = PrimitiveSet(boxes.primitives[:1])
    places = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3))
    expected = (np.abs(places) <= 0.5).all(1)
    np.testing.assert_array_equal(building.inside(places @ scaled[:3, :3].T + scaled[:3, 3])[:, 0], expected)


def test_what_query_instances_writes_is_a_file_of_boxes(tmp_path: Path) -> None:
    box = OrientedBox(T[:3, 3], np.array((0.5, 0.6, 0.0)), T[:3, :3])
    thing = Instance(3, 6, "sofa", 0.9, T[:3, 3], box, np.zeros((40, 3), np.int32))
    (tmp_path / "things.json").write_text(json.dumps({"map": "a", **answer_instances((0, 0, 1), [thing])}))
    (sofa,) = load_boxes(tmp_path / "things.json").primitives
    assert (sofa.id, sofa.class_name, sofa.shape, sofa.thing) == (3, "sofa", "box", True)
    np.testing.assert_allclose(sofa.size, (0.5, 0.6, 0.001))  # the flattest box that there is
    (wider,) = load_boxes(tmp_path / "things.json", query_margin_m=0.05).primitives
    np.testing.assert_allclose(wider.size, (0.6, 0.7, 0.1))
    np.testing.assert_allclose(sofa.T_world_box, T, atol=1e-4)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"size": [1, 0, 1]}, "size must be at least 0.001 m"),
        ({"size": None}, "size, three metres, is missing"),
        ({"size": [1, 1, 1e6]}, "size must be metres within 100 km"),
        ({"T_world_box": np.diag((2.0, 1, 1, 1)).tolist()}, "not a rotation"),
        ({"T_world_box": at(1e9).tolist()}, r"the box is at \[1.e\+09"),
        ({"shape": "cone"}, "shape.*cone|cone.*shape"),
        ({"sise": [1, 1, 1]}, "did you mean .size"),
        ({"shape": "prism", "polygon": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "outline"),
        ({"shape": "prism", "polygon": [[0, 0], [1, 1], [0, 0]]}, "3 different corners, got 2"),
        ({"shape": "mesh", "vertices": CORNERS.tolist(), "faces": [[0, 1, 2]]}, "the surface is open"),
        ({"shape": "mesh", "vertices": [], "faces": []}, "needs vertices and faces"),
        ({"stamps": [[5, T.tolist()], [5, T.tolist()]]}, "stamps must be .* each number once"),
        ({"stamps": [[5, (2 * T).tolist()]]}, "stamps, pose at 5: the last row"),
        ({"stamps": [[5, T.tolist()]], "frames": [[5, T.tolist()]]}, "has stamps and frames"),
    ],
)
def test_bad_boxes_are_refused_with_their_number(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "boxes.json", entry(), entry(**{"id": 2} | changed))
    number = "" if isinstance(changed.get("id"), str) else rf" \(id {changed.get('id', 2)}\)"
    with pytest.raises(ConfigError, match=rf"boxes\.json, box 2{number}: .*{message}"):
        load_boxes(path)


def test_two_boxes_of_one_id_and_classes_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "boxes.json", entry(), entry(id=70000), entry(), entry(id="a"))
    path.write_text("\ufeff" + path.read_text())
    with pytest.raises(ConfigError, match=r"box 2 \(id 70000\).*box 3 \(id 1\): id 1 is that of box 1.*box 4: "):
        load_boxes(path)
    path = write(path, entry(), entry(id=2, **{"class": "bathtup"}))
    with pytest.raises(ConfigError, match=r"box with id 2: .*did you mean 'bathtub'"):
        with_classes(load_boxes(path), ROOMS, path, "weights")
    for merge, says in (
        ({"chair": ["stool"]}, "'stool'"),
        ({"chiar": ["stool"]}, "'chiar'; did you mean 'chair'"),
        ({"chair": []}, "box with id 2: .*'lorry'"),
    ):
        path = write(path, entry(), entry(id=2, **{"class": "lorry"}), merge=merge)
        with pytest.raises(ConfigError, match=says):
            with_classes(load_boxes(path), ROOMS, path, "weights")


XML_HEAD = '<?xml version="1.0" encoding="{}"?><a/>'
CHARSETS = ("utf-32", "gb2312", "no-such", "base64", "idna", "cp037")
JSON_WITHOUT = ("", "{", "[1]", '{"boxes": 3}', '{"boxes": [], "merg": {}}')


@pytest.mark.parametrize("text", [*JSON_WITHOUT, "<a", "<a></a>", *(XML_HEAD.format(name) for name in CHARSETS)])
def test_files_without_boxes_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "boxes.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"boxes\.json"):
        load_boxes(path)
    with pytest.raises(ConfigError, match=r"nothing\.json"):
        load_boxes(tmp_path / "nothing.json")


def test_an_outline_or_mesh_is_where_it_is_drawn_wherever_its_origin_is(tmp_path: Path) -> None:
    triangles = np.concatenate((QUADS[:, :3], QUADS[:, (0, 2, 3)])).tolist()
    ring = [[10, 0], [19, 0], [19, 0], [19, 4], [10, 0]]  # closed, one corner twice
    entries = [
        entry(shape="prism", size=[1, 1, 0.3], polygon=ring, stamps=[[7, T.tolist()]]),
        entry(id=2, shape="mesh", size=None, vertices=(CORNERS + 10).tolist(), faces=triangles),
    ]
    prism, mesh = load_boxes(write(tmp_path / "a.json", *entries)).primitives
    np.testing.assert_allclose(prism.T_world_box, prism.stamps[0][1] if prism.stamps else None)
    for box, low, high in ((prism, (10, 0, -0.15), (19, 4, 0.15)), (mesh, (10 - 0.5,) * 3, (10 + 0.5,) * 3)):
        drawn = (box.mesh()[0] - T[:3, 3]) @ T[:3, :3]
        np.testing.assert_allclose((drawn.min(0), drawn.max(0)), (low, high), atol=1e-12)
    for box, size in ((prism, (4.5, 2, 0.15)), (mesh, (0.5, 0.5, 0.5))):
        core = (resized(box, 0.5 * box.size).mesh()[0] - box.T_world_box[:3, 3]) @ box.T_world_box[:3, :3]
        np.testing.assert_allclose((core.min(0), core.max(0)), np.outer((-0.5, 0.5), size), atol=1e-12)


def test_the_example_of_the_docs_is_a_file_of_boxes(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text()
    (tmp_path / "boxes.json").write_text(text.split("```json")[1].split("```")[0])
    car, road = load_boxes(tmp_path / "boxes.json").primitives
    assert (car.thing, road.thing) == (True, False)
    np.testing.assert_allclose(road.mesh()[0].min(0)[:2], (0, 0), atol=1e-12)
    assert PrimitiveSet([road]).inside(road.T_world_box[:3, 3] + np.array([(0.1, -0.1, 0)])).all()


def test_kitti360_moving_objects_are_boxes_with_poses_by_frame(tmp_path: Path) -> None:
    moves = [(i, "car", 20 - i, T @ at(-i)) for i in range(3)]
    xml = kitti_xml(*moves, (4, "truck", 3, T), (5, "car", -1, T), instance=7)
    (tmp_path / "a.xml").write_text(xml)
    boxes = load_boxes(tmp_path / "a.xml")
    car, truck, parked = boxes.primitives
    assert [n for n, _ in car.frames or ()] == [18, 19, 20] and car.stamps is None and not parked.moves
    for number, pose in car.frames or ():
        np.testing.assert_allclose(pose, T @ at(number - 20), atol=1e-12)
        assert car.pose_at(number) is None
    np.testing.assert_array_equal(car.T_world_box, (car.frames or ())[0][1])
    assert truck.id == 5


def test_xml_of_kitti360_goes_with_labels_of_fewer_classes(tmp_path: Path) -> None:
    names = ("car", "trailer", "parking", "truck", "lamp", "garage")
    (path := tmp_path / "a.xml").write_text(kitti_xml(*((i, name, -1, T) for i, name in enumerate(names))))
    boxes, known = with_classes(load_boxes(path), LABELS, path, "weights")
    assert known == LABELS and len(boxes.primitives) == 6 and not boxes.merge  # these labels know all
    few = make_label_set("few", ["car", "sidewalk", "building", "garage"])
    with structlog.testing.capture_logs() as logs:
        boxes, known = with_classes(load_boxes(path), few, path, "weights")
    assert [p.class_name for p in boxes.primitives] == ["car", "trailer", "parking", "garage"]
    assert boxes.merge == {"sidewalk": ("parking",), "car": ("trailer",)} and boxes.left_out == 2
    assert known.names == (*few.names, "trailer", "parking") and "no class lamp, truck" in logs[0]["reason"]


def test_objects_of_xml_that_cannot_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    xml = kitti_xml(
        (0, "car", -1, T), (69999, "car", -1, T), (3, "", -1, T), (4, "gate", -1, 1e9 * T), (5, "lamp", -1, T)
    )
    first = xml.rindex("<faces")
    (tmp_path / "a.xml").write_text("\ufeff" + xml[:first] + xml[first:].replace("0 1 3 2", "0.7 1 3 2"))
    boxes = load_boxes(tmp_path / "a.xml")
    assert [p.id for p in boxes.primitives] == [1]
    problems = ("65535", "`class`", "100 km", "must be a whole number")
    for sentence, where, problem in zip(
        boxes.bad, ("2 (id 70000)", "3 (id 4)", "4 (id 5)", "5 (id 6)"), problems, strict=True
    ):
        assert sentence.startswith(f"box {where}: ") and problem in sentence
    (tmp_path / "a.xml").write_text(kitti_xml((69999, "car", -1, T)))
    with pytest.raises(ConfigError, match=r"box 1 \(id 70000\): .*65535"):
        load_boxes(tmp_path / "a.xml")


def test_poses_by_frame_take_the_times_of_a_log_of_their_drive(tmp_path: Path) -> None:
    far = tuple((number, at(number, 0, 1)) for number in (5, 7, 8))
    boxes = BoxFile(
        (
            Primitive(3, "chair", "box", at(1, 2, 0.5), np.array([0.5, 0.4, 1]), True),
            Primitive(7, "car", "box", far[0][1], np.array([4, 2, 1.5]), True, frames=far),
            Primitive(9, "car", "box", at(0, 0, 0), np.array([4, 2, 1.5]), True, frames=((90, at(0, 0, 0)),)),
        )
    )
    frames = [replace(f, seq=5 + i) for i, f in enumerate(tiny_frames(3))]
    for name, source in (("drive", "kitti360 2013_05_28_drive_0000_sync"), ("robot", "my robot")):
        info = StreamInfo(source, {f.camera_id: f.intrinsics for f in frames}, ROOMS)
        with LogWriter(tmp_path / f"{name}.mcap", info) as writer:
            for frame in frames:
                writer.write_frame(frame)
    path = tmp_path / "boxes.json"
    with open_log(tmp_path / "drive.mcap") as log:
        timed, dropped = with_times(boxes, path, log)
    with (
        open_log(tmp_path / "robot.mcap") as log,
        pytest.raises(ConfigError, match=r"boxes\.json: boxes have poses by frame.*'my robot'"),
    ):
        with_times(boxes, path, log)
    still, car = timed.primitives
    assert dropped == [9] and not still.moves and car.frames is None
    assert [(t, T[0, 3]) for t, T in car.stamps or ()] == [(frames[0].stamp_ns, 5), (frames[2].stamp_ns, 7)]
