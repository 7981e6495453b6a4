"""What a bridge says of the map that it follows."""

from __future__ import annotations

from typing import Any

from semantic_mapper.nodes.bridge.feed import _MapFollower
from semantic_mapper.nodes.options import FoxgloveOptions
from semantic_mapper.queries.graph import GraphTracker, SceneGraph
from semantic_mapper.queries.snapshot import MapMirror
from tests.queries.scene import LABELS, whole


class Sent:
    """Of an ``Outlet``, what is needed here."""

    def __init__(self) -> None:
        self.graphs: list[SceneGraph] = []

    def send_graph(self, graph: SceneGraph, stamp_ns: int) -> None:
        self.graphs.append(graph)


def test_why_there_is_no_graph_is_told_until_there_is_one() -> None:
    outlet: Any = Sent()
    nobody: Any = None
    follower = _MapFollower(nobody, outlet, FoxgloveOptions())
    follower._send_graph(GraphTracker(), MapMirror(0.02, 4.0, LABELS).snapshot())
    assert follower.no_graph.startswith("no graph: which way is up cannot be found") and not outlet.graphs
    follower._send_graph(GraphTracker((1, 0, 0)), whole())
    assert follower.no_graph == "no graph: no floor was found"
    follower._send_graph(GraphTracker(), whole())
    assert follower.no_graph == "" and outlet.graphs[-1].floors
