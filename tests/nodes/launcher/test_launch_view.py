"""What `view --status` makes of the statuses of a launch: rates and losses of every kind of node."""

from __future__ import annotations

from semantic_mapper.nodes.launcher.running import LaunchView
from semantic_mapper.transport.messages import Status

S = 1_000_000_000
TOTALS = {
    "oak": {"published": 20, "missing": 1, "frames": 20, "no_pose": 1},
    "mapper": {"published": 18, "fused": 4, "missed": 2, "refused": 1, "rejected": 1, "dropped": 0, "step_us": 200_000},
    "recorder": {"recorded": 20, "messages": 30, "missed": 1, "lost": 2, "rejected": 0, "log_kb": 3072, "parts": 2},
    "player": {"published": 10},
}


def view_after(seconds: int) -> LaunchView:
    """Totals grow by as much in each second; the nodes told theirs a quarter of a second before."""
    view = LaunchView()
    for second in range(1, seconds + 1):
        for name, totals in TOTALS.items():
            counters = {key: second * value for key, value in totals.items()} | {"pid": 7}
            view.add(Status(name, "running", second * S, counters, {"status": 0.25, "frame": 0.5}))
        view.add(Status("launch", "running", second * S, {"pid": 1, "nodes": len(TOTALS)}))
    return view


def test_rates_losses_and_sizes_of_every_kind_of_node() -> None:
    nodes = view_after(4).to_json()["nodes"]
    assert nodes["oak"]["rates_hz"] == {"published": 20.0} and nodes["oak"]["lost"] == 4 * 1
    assert nodes["mapper"]["rates_hz"] == {"published": 18.0, "fused": 4.0}
    assert nodes["mapper"]["lost"] == 4 * (2 + 1 + 1) and nodes["mapper"]["step_ms"] == 50.0
    assert nodes["recorder"]["rates_hz"] == {"recorded": 20.0, "messages": 30.0}
    assert nodes["recorder"]["lost"] == 4 * (1 + 2) and nodes["recorder"]["log_mb"] == 12.0
    assert nodes["player"]["rates_hz"] == {"published": 10.0} and nodes["player"]["lost"] is None
