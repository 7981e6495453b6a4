"""Answers about a map as tables."""

from __future__ import annotations

import io
from functools import partial

import numpy as np
from rich.console import Console

from semantic_mapper.nodes.map_answers import answer_instances, answer_table
from semantic_mapper.queries.instances import Instance, OrientedBox


def test_a_narrow_terminal_cuts_no_number() -> None:
    thing = {
        "id": 12345,
        "class": "otherfurniture",
        "confidence": 0.87,
        "voxels": 98765,
        "measured": 0.43,
        "centroid": [-12.34, 5.67, 123.45],
        "box": {"size": [0.98, 11.22, 3.21]},
    }
    text = io.StringIO()
    console = Console(file=text, width=30, color_system=None)
    console.print(answer_table({"map": "map.npz", "question": "instances", "instances": [thing]}, 30), soft_wrap=True)
    for number in ("12345", "0.87", "98765", "43 %", "-12.34 5.67 123.45", "0.98 11.22 3.21"):
        assert number in text.getvalue()


def test_things_that_have_gone_stand_behind_the_others_with_the_time() -> None:
    box = OrientedBox(np.zeros(3), np.ones(3), np.eye(3))
    made = partial(
        Instance, class_id=5, confidence=0.5, centroid=np.zeros(3), box=box, voxels=np.zeros((40, 3), np.int32)
    )
    stamps = {1: 1_500_000_000, 2: None, 3: 2_250_000_000}
    things = [made(number, class_name="chair", gone_ns=stamp_ns) for number, stamp_ns in stamps.items()]
    found = answer_instances((0, 0, 1), things)
    assert [thing["id"] for thing in found["instances"]] == [2] and "gone_ns" not in found["instances"][0]
    assert [(thing["id"], thing["gone_ns"]) for thing in found["gone"]] == [(3, 2_250_000_000), (1, 1_500_000_000)]
    assert "gone" not in answer_instances((0, 0, 1), things[1:2])
    text = io.StringIO()
    console = Console(file=text, width=120, color_system=None)
    console.print(answer_table({"map": "live", **found}, 120))
    assert "gone at, s" in text.getvalue() and [line for line in text.getvalue().splitlines() if "2.25" in line]
