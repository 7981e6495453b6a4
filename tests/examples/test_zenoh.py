"""The example that publishes a map to Zenoh: what a Zenoh client receives of it."""

import importlib
import json
import threading
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.nodes.map_feed import POINT
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import free_port
from tests.queries.scene import LABELS, whole_map

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "zenoh"


def test_a_subscriber_receives_points_and_graph_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    zenoh = pytest.importorskip("zenoh")
    monkeypatch.syspath_prepend(str(EXAMPLE))
    example = importlib.import_module("publish")
    address, stop, came = f"tcp/127.0.0.1:{free_port()}", threading.Event(), threading.Condition()
    samples: dict[str, zenoh.Sample] = {}

    def keep(sample: zenoh.Sample) -> None:
        with came:
            samples[str(sample.key_expr)] = sample
            came.notify_all()

    known = zenoh.Config()
    for key, value in {"mode": "client", "connect/endpoints": [address], "scouting/multicast/enabled": False}.items():
        known.insert_json5(key, json.dumps(value))
    with a_folder() as folder:
        endpoint = f"ipc://{folder / 'query'}"
        with (
            answering(endpoint, whole_map()),
            MapClient(endpoint, timeout_s=60) as client,
            zenoh.open(example.zenoh_config(listen=address)) as session,
            zenoh.open(known) as other,
        ):
            subscriber = other.declare_subscriber("semantic_mapper/**", keep)
            worker = threading.Thread(target=example.publish, args=(client, session, stop, 0.2))
            worker.start()
            with came:
                assert came.wait_for(lambda: len(samples) == 2, 120)
            stop.set()
            worker.join(60)
            assert not worker.is_alive()
            subscriber.undeclare()
    points = np.frombuffer(samples["semantic_mapper/map/points"].payload.to_bytes(), POINT)
    attachment = samples["semantic_mapper/map/points"].attachment
    assert attachment is not None
    about = json.loads(attachment.to_bytes())
    assert len(points) == about["points"] > 0 and set(points["label"]) <= {*LABELS.ids, LABELS.ignore_id}
    assert json.loads(samples["semantic_mapper/graph"].payload.to_bytes())["floors"]
