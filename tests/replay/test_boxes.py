"""Files of boxes: three formats, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive, PrimitiveSet
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.cli.map_answers import answer_instances
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.oriented_box import OrientedBox
from semantic_mapper.replay.boxes import QUERY_MARGIN_M, check_classes, load_boxes, save_boxes

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


def kitti_xml(*objects: tuple[int, str, int, np.ndarray]) -> str:
    listed = "".join(
        f"<object{index}><index>{index}</index><label>{label}</label><timestamp>{stamp}</timestamp>"
        f"{matrix('transform', transform)}{matrix('vertices', CORNERS)}{matrix('faces', QUADS, 'i')}</object{index}>"
        for index, label, stamp, transform in objects
    )
    return f"<?xml version='1.0'?><opencv_storage>{listed}</opencv_storage>"


def same(a: Primitive, b: Primitive) -> bool:
    arrays = [(a.T_world_box, b.T_world_box), (a.size, b.size), (a.polygon, b.polygon)]
    arrays += [(a.vertices, b.vertices), (a.faces, b.faces)]
    equal = all(np.array_equal(np.array(x, float), np.array(y, float), equal_nan=True) for x, y in arrays)
    named = (a.id, a.class_name, a.shape, a.thing) == (b.id, b.class_name, b.shape, b.thing)
    stamps = [[(s, T.tolist()) for s, T in p.stamps or ()] for p in (a, b)]
    return equal and named and stamps[0] == stamps[1]


def test_all_shapes_are_read_and_written(tmp_path: Path) -> None:
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
    save_boxes(tmp_path / "b.json", boxes)
    again = load_boxes(tmp_path / "b.json")
    assert again.merge == {"chair": ("sofa",)}
    assert all(same(a, b) for a, b in zip(boxes.primitives, again.primitives, strict=True))


def test_kitti360_xml_survives_a_round_trip(tmp_path: Path) -> None:
    scaled = T.copy()
    scaled[:3, :3] *= (4.0, 2.0, 1.5)
    xml = kitti_xml((0, "building", -1, scaled), (1, "driveway", -1, T), (2, "car", 7, T), (3, "unknownObject", -1, T))
    (tmp_path / "drive.xml").write_text(xml)
    boxes = load_boxes(tmp_path / "drive.xml")
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
    save_boxes(tmp_path / "boxes.json", boxes)
    again = load_boxes(tmp_path / "boxes.json")
    assert all(same(a, b) for a, b in zip(boxes.primitives, again.primitives, strict=True))


def test_what_query_instances_writes_is_a_file_of_boxes(tmp_path: Path) -> None:
    box = OrientedBox(T[:3, 3], np.array((0.5, 0.6, 0.0)), T[:3, :3])
    thing = Instance(3, 6, "sofa", 0.9, T[:3, 3], box, np.zeros((40, 3), np.int32))
    (tmp_path / "things.json").write_text(json.dumps({"map": "a", **answer_instances((0, 0, 1), [thing])}))
    (sofa,) = load_boxes(tmp_path / "things.json").primitives
    assert (sofa.id, sofa.class_name, sofa.shape, sofa.thing) == (3, "sofa", "box", True)
    np.testing.assert_allclose(sofa.size, np.array((0.5, 0.6, 0.0)) + 2 * QUERY_MARGIN_M)
    np.testing.assert_allclose(sofa.T_world_box, T, atol=1e-4)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"size": [1, 0, 1]}, "size must be above 0"),
        ({"size": [1, float("nan"), 1]}, "size holds NaN"),
        ({"size": [1, 1]}, "size must be 3 numbers"),
        ({"T_world_box": (2 * np.eye(4)).tolist()}, "last row"),
        ({"T_world_box": np.diag((2.0, 1, 1, 1)).tolist()}, "not a rotation"),
        ({"id": 0}, "id must be"),
        ({"id": 65536}, "id must be"),
        ({"class": 3}, "class must be"),
        ({"shape": "cone"}, "shape must be one of"),
        ({"sise": [1, 1, 1]}, "did you mean 'size'"),
        ({"shape": "prism", "polygon": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "outline"),
        ({"shape": "mesh", "vertices": CORNERS.tolist(), "faces": [[0, 1, 2]]}, "the surface is open"),
        ({"stamps": [[0.5, T.tolist()]]}, "whole numbers of nanoseconds"),
    ],
)
def test_bad_boxes_are_refused_with_their_number(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "boxes.json", entry(), entry(**{"id": 2} | changed))
    with pytest.raises(ConfigError, match=rf"boxes\.json, box 2: .*{message}"):
        load_boxes(path)


def test_two_boxes_of_one_id_and_classes_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "boxes.json", entry(), entry(id=2), entry())
    with pytest.raises(ConfigError, match="box 3: id 1 is that of box 1"):
        load_boxes(path)
    path = write(path, entry(), entry(id=2, **{"class": "bathtup"}))
    with pytest.raises(ConfigError, match=r"box 2: .*did you mean 'bathtub'"):
        check_classes(load_boxes(path), ROOMS, path)
    path = write(path, entry(), merge={"chair": ["stool"]})
    with pytest.raises(ConfigError, match=r"merge: .*'stool'"):
        check_classes(load_boxes(path), ROOMS, path)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"boxes": 3}', "<a", "<a></a>", '{"boxes": [], "merge": 3}'])
def test_files_without_boxes_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "boxes.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"boxes\.json"):
        load_boxes(path)
    with pytest.raises(ConfigError, match=r"nothing\.json"):
        load_boxes(tmp_path / "nothing.json")
