"""What a node says of itself always goes out, or is left out; it never ends the node."""

import math
from pathlib import Path

from structlog.testing import capture_logs

from semantic_mapper.nodes.publishing import StatusReport
from semantic_mapper.transport.codec import decode_as, encode
from semantic_mapper.transport.messages import MAX_COUNT, Status
from semantic_mapper.transport.sockets import NewestSubscriber, Publisher


def test_values_beyond_all_bounds_are_sent_as_the_nearest_one_that_can_be() -> None:
    counters = {"huge": 2**70, "negative": -5, "w" * 200: 3, **{f"n{i}": i for i in range(300)}}
    ages = {"endless": math.inf, "unknown": math.nan, "ahead": -math.inf}
    sent = Status("eye", "running", 1, counters, ages, ("x" * 9000, "caf\udce9.mcap", *["more"] * 99))
    status = decode_as(Status, encode(sent))
    assert (status.counters["huge"], status.counters["negative"], status.counters["w" * 128]) == (MAX_COUNT, 0, 3)
    assert len(status.counters) == 256 and len(status.degraded) == 64
    assert status.ages_s.keys() == {"endless", "ahead"} and all(map(math.isfinite, status.ages_s.values()))
    assert len(status.degraded[0]) == 4096 and status.degraded[1] == "caf?.mcap"


def test_a_status_that_cannot_be_sent_is_logged_and_the_next_one_goes_out(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/node"
    with (
        capture_logs() as told,
        Publisher(endpoint) as publisher,
        NewestSubscriber([endpoint], ("status",)) as subscriber,
    ):
        publisher.wait_for_subscribers("status", 1, 30)
        StatusReport("no such name", publisher).publish("running")
        assert StatusReport("eye", publisher).publish("running") == subscriber.receive(30)
    assert [entry["event"] for entry in told] == ["status_not_reported"]
