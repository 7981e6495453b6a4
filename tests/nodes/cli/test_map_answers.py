"""Answers about a map as tables."""

from __future__ import annotations

import io

from rich.console import Console

from semantic_mapper.nodes.cli.map_answers import answer_table


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
