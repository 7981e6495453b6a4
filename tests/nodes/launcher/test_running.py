"""What is said where nobody can answer, and what `view --status` makes of statuses."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.nodes.launcher.running import LaunchView
from semantic_mapper.transport.messages import Status
from tests.nodes.support import refused


def test_a_mapper_without_socket_is_not_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MapClient, "_ask_about", Mock(side_effect=AssertionError("asked all the same")))
    mapper = f"ipc://{tmp_path}/query"
    for words in (("query", mapper, "info"), ("info", mapper)):
        assert f"{mapper}: there is no such socket" in refused(*words)


S = 1_000_000_000
TOTALS = {
    "oak": {"published": 20, "missing": 1, "frames": 20, "no_pose": 1},
    "mapper": {"published": 18, "fused": 4, "missed": 2, "refused": 1, "rejected": 1, "dropped": 0, "step_us": 200_000},
    "recorder": {"recorded": 20, "messages": 30, "missed": 1, "lost": 2, "rejected": 0, "log_kb": 3072, "parts": 2},
    "player": {"published": 10},
}


def test_rates_losses_and_sizes_of_every_kind_of_node() -> None:
    view = LaunchView()
    for second in range(1, 5):  # totals grow by as much in each second
        for name, totals in TOTALS.items():
            counters = {key: second * value for key, value in totals.items()} | {"pid": 7}
            view.add(Status(name, "running", second * S, counters, {"status": 0.25, "frame": 0.5}))
        view.add(Status("launch", "running", second * S, {"pid": 1, "nodes": len(TOTALS)}))
    nodes = view.to_json()["nodes"]
    assert nodes["oak"]["rates_hz"] == {"published": 20.0} and nodes["oak"]["lost"] == 4 * 1
    assert nodes["mapper"]["rates_hz"] == {"published": 18.0, "fused": 4.0}
    assert nodes["mapper"]["lost"] == 4 * (2 + 1 + 1) and nodes["mapper"]["step_ms"] == 50.0
    assert nodes["recorder"]["rates_hz"] == {"recorded": 20.0, "messages": 30.0}
    assert nodes["recorder"]["lost"] == 4 * (1 + 2) and nodes["recorder"]["log_mb"] == 12.0
    assert nodes["player"]["rates_hz"] == {"published": 10.0} and nodes["player"]["lost"] is None
