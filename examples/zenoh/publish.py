"""Publish the map of a running mapper to Zenoh: its points and its scene graph, whenever they have changed.

    semantic-mapper up camera --set camera.kind=oak
    python examples/zenoh/publish.py ipc://FOLDER/query          # FOLDER: as `up` says where its sockets are

Keys: `semantic_mapper/map/points` holds 20 bytes a point (see ``POINT`` in nodes/map_feed.py), with the classes
as JSON in its attachment; `semantic_mapper/graph` holds JSON as of `semantic-mapper query MAP graph`. Zenoh's own
configuration file says who may connect (TLS, a router): `--config zenoh.json5`; without one, this machine alone.
"""

from __future__ import annotations

import argparse
import json
import threading
import time

import msgspec
import numpy as np
import zenoh

from semantic_mapper import MapClient
from semantic_mapper.errors import MapError, TransportError
from semantic_mapper.nodes.map_answers import answer_graph
from semantic_mapper.nodes.map_feed import describe_map, pack_points, thinned
from semantic_mapper.queries.graph import GraphTracker
from semantic_mapper.queries.surface import surface_points, surface_voxels

LISTEN = "tcp/127.0.0.1:7447"


def zenoh_config(file: str = "", listen: str = LISTEN) -> zenoh.Config:
    """Of a file, or a peer that listens at one address of this machine and looks for nobody."""
    if file:
        return zenoh.Config.from_file(file)
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [listen],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def publish(client: MapClient, session: zenoh.Session, stop: threading.Event, period_s: float = 2.0) -> None:
    """Send points and graph after each change of the map until ``stop``; a mapper that restarts is found again.

    Zenoh waits for slow subscribers with its maps, which are worth it, and cuts them off after five seconds.
    """
    options = {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.BACKGROUND}
    points_key = session.declare_publisher("semantic_mapper/map/points", **options)
    graph_key = session.declare_publisher("semantic_mapper/graph", **options)
    shown, mirror, tracker = None, None, GraphTracker()
    while not stop.wait(period_s):
        try:
            current = client.mirror()
            snapshot = current.snapshot()
        except (TransportError, MapError) as error:  # it starts, or is gone for a moment
            print(f"no map: {error}")
            continue
        if current is not mirror:  # of another mapper
            mirror, tracker = current, GraphTracker()
        if shown is not None and np.array_equal(shown, snapshot.serials):
            continue
        shown, now_ns = snapshot.serials, time.monotonic_ns()
        points = surface_points(snapshot, surface_voxels(snapshot))
        about = describe_map(snapshot, len(points.xyz), now_ns)
        few = thinned(points)
        points_key.put(pack_points(few, few.rgb), attachment=msgspec.json.encode(about))
        try:
            graph = tracker.update(snapshot)
        except MapError as error:  # no floor was seen yet
            print(f"no graph: {error}")
        else:
            graph_key.put(msgspec.json.encode({"stamp_ns": now_ns, **answer_graph(graph)}))


def main() -> None:
    """Publish until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("query", help="where the mapper answers, such as ipc://FOLDER/query or tcp://127.0.0.1:5561")
    parser.add_argument("--config", default="", help="Zenoh's configuration file")
    arguments = parser.parse_args()
    with MapClient(arguments.query, attempts=1) as client, zenoh.open(zenoh_config(arguments.config)) as session:
        try:
            publish(client, session, threading.Event())
        except KeyboardInterrupt:
            return


if __name__ == "__main__":
    main()
