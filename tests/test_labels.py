import itertools

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import LabelError
from semantic_mapper.labels import NYU40, PROVIDED, SCANNET20, STUFF_NAMES, LabelSet, make_label_set

GAPS = make_label_set("gaps", ["wall", "chair", "lamp"], ids=[9, 2, 200], ignore_id=255)
RED = (255, 0, 0)


@pytest.mark.parametrize("label_set", [*PROVIDED.values(), GAPS], ids=lambda s: s.name)
def test_ids_and_channels_convert_back_and_forth(label_set: LabelSet) -> None:
    ids = np.array((*label_set.ids, label_set.ignore_id), np.uint8)
    np.testing.assert_array_equal(label_set.to_ids(label_set.to_channels(ids)), ids)
    channels = np.arange(-1, len(label_set))
    np.testing.assert_array_equal(label_set.to_channels(label_set.to_ids(channels)), channels)


def test_foreign_ids_are_refused_by_number_and_place() -> None:
    with pytest.raises(LabelError) as caught:
        GAPS.to_channels(np.array([9, 3, 77, 3], np.uint8), "frame 5 of kitchen.mcap")
    message = str(caught.value)
    assert "frame 5 of kitchen.mcap" in message and "[3, 77]" in message and "'gaps'" in message


@pytest.mark.parametrize("label_set", PROVIDED.values(), ids=lambda s: s.name)
def test_colours_of_a_set_can_be_told_apart(label_set: LabelSet) -> None:
    lab = cv2.cvtColor(np.array([label_set.colors], np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    for a, b in itertools.combinations(range(len(label_set)), 2):
        distance = float(np.linalg.norm(lab[a] - lab[b]))
        assert distance > 15, f"{label_set.names[a]} and {label_set.names[b]} look the same"
    assert lab[:, 0].min() > 30  # black means unknown


def test_channels_of_another_set_are_found_by_name() -> None:
    table = SCANNET20.channel_map_from(NYU40)
    assert table.shape == (256,)
    for channel, (class_id, name) in enumerate(zip(SCANNET20.ids, SCANNET20.names, strict=True)):
        assert NYU40.names[class_id - 1] == name
        assert table[class_id] == channel
    assert table[NYU40.ids[NYU40.names.index("ceiling")]] == -1
    assert table[NYU40.ignore_id] == -1


def test_classes_that_get_one_name_become_one_class() -> None:
    flat = make_label_set("flat", ["couch", "armchair", "lamp", "sofa"], ids=[9, 4, 2, 6], ignore_id=0)
    merged, table = flat.renamed({"couch": "sofa", "armchair": "sofa"})
    assert dict(zip(merged.names, merged.ids, strict=True)) == {"lamp": 2, "sofa": 4}
    assert table[[9, 4, 6, 2, 0, 77]].tolist() == [4, 4, 4, 2, 0, 77]
    assert merged.colors == (flat.colors[2], flat.colors[1])
    merged.to_channels(table[np.array([9, 4, 2, 6, 0], np.uint8)])


@pytest.mark.parametrize(
    ("ids", "names", "ignore_id", "says"),
    [
        ((1, 1), ("a", "b"), 0, "twice"),
        ((1, 2), ("a", "a"), 0, "twice"),
        ((0, 1), ("a", "b"), 0, "needs an ignore id that is no class"),
        ((1, 256), ("a", "b"), 0, "0..255"),
        ((1, -1), ("a", "b"), 0, "0..255"),
        ((1, 2), ("a", "b"), 300, "0..255"),
        ((1,), ("a", "b"), 0, "one entry a class"),
        ((), (), 0, "no classes"),
    ],
)
def test_sets_that_contradict_themselves_are_refused(
    ids: tuple[int, ...], names: tuple[str, ...], ignore_id: int, says: str
) -> None:
    with pytest.raises(LabelError, match=says):
        LabelSet("bad", ids, names, (RED,) * len(names), ignore_id)


def test_things_are_what_is_not_stuff() -> None:
    assert GAPS.thing_ids(STUFF_NAMES) == (2, 200)
    assert GAPS.thing_ids(()) == (9, 2, 200) and GAPS.thing_ids(("chair", "lamp")) == (9,)
    names = {name for label_set in PROVIDED.values() for name in label_set.names}
    assert names >= STUFF_NAMES, "names that no set has are misspelt"
    assert {"chair", "car", "door"} <= names - STUFF_NAMES


def test_a_set_without_an_ignore_id_gets_the_highest_id_that_is_no_class() -> None:
    assert make_label_set("all", ["wall", "floor"], ids=[0, 1], ignore_id=None).ignore_id == 255
    assert make_label_set("all", ["wall", "sky"], ids=[0, 255], ignore_id=None).ignore_id == 254
    with pytest.raises(LabelError, match="all 256 ids are classes"):
        make_label_set("all", [str(i) for i in range(256)], ids=range(256), ignore_id=None)
    with pytest.raises(LabelError, match="needs an ignore id"):
        LabelSet("none", (0,), ("wall",), (RED,), None)  # type: ignore[arg-type]
