"""Files of boxes: both formats, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.scene.boxes import PrimitiveSet
from semantic_mapper.fields.scene.primitives import resized
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.nodes.map_answers import answer_instances
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.replay.boxes import load_boxes, with_classes
from semantic_mapper.replay.importers.kitti360 import LABELS

T = pose_matrix(np.array((1.0, 2.0, 0.5)), np.array((0, 0, 0.3, 0.9)))
CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
QUADS = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])


def entry(**changed: Any) -> dict[str, Any]:
    given = {"id": 1, "class": "chair", "shape": "box", "T_world_box": T.tolist(), "size": [1, 1, 1], "thing": True}
    return {k: v for k, v in (given | changed).items() if v is not None}


def write(path: Path, *entries: dict[str, Any], **rest: Any) -> Path:
    path.write_text(json.dumps({"boxes": list(entries), **rest}))
    return path


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


JSON_WITHOUT = ("", "{", "[1]", '{"boxes": 3}', '{"boxes": [], "merg": {}}')


@pytest.mark.parametrize("text", [*JSON_WITHOUT, "<a></a>"])
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


def test_boxes_of_finer_classes_than_the_labels_go_with_the_class_that_stands_for_them(tmp_path: Path) -> None:
    names = ("car", "trailer", "parking", "garage")
    path = write(tmp_path / "a.json", *(entry(id=i, **{"class": name}) for i, name in enumerate(names, 1)))
    boxes, known = with_classes(load_boxes(path), LABELS, path, "weights")
    assert known == LABELS and not boxes.merge  # these labels know all
    few = make_label_set("few", ["car", "sidewalk", "building", "garage"])
    boxes, known = with_classes(load_boxes(path), few, path, "weights")
    assert boxes.merge == {"sidewalk": ("parking",), "car": ("trailer",)}
    assert known.names == (*few.names, "trailer", "parking")
