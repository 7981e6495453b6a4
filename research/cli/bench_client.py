"""The client of ``bench queries``: a process of its own that asks a running mapper at an even rate when told to."""

from __future__ import annotations

import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NamedTuple

from research.train.worker import prepare_worker

if TYPE_CHECKING:
    from semantic_mapper.client import MapClient
    from semantic_mapper.types import Float64

READY, ASK, ASKING, REST = "ready", "ask", "asking", "rest"
KINDS = ("at", "nearest", "cast_rays", "occupancy", "distance_field", "instances", "changes")
BOX_M = 1.0  # edge of the box of `distance_field`
MAX_RAY_M = 10.0
RAYS = 256  # that look for surfaces to ask about
TIMEOUT_S = 120.0  # of the first question, for which kernels may compile


class Asked(NamedTuple):
    """One question: its kind, and what it took from asking to having the answer decoded."""

    kind: str
    ms: float


def query_on_command(told: Connection, endpoint: str, eyes: Float64, rate_hz: float) -> None:
    """Ask everything once, uncounted, and say ``READY``; then answer every ``ASK`` with ``ASKING`` and begin.

    Before ``ASKING`` a few questions pass uncounted, so that the mapper has brought its mirror up to date. ``REST`` is
    answered with a list of ``Asked``, once the answer under way is there. Ends with the other end of ``told``.

    Args:
        told: To the process that maps.
        endpoint: Of its query service.
        eyes: (N, 3) world metres, places in free space from which surfaces can be seen.
        rate_hz: Questions a second; one that takes longer delays those after it.
    """
    prepare_worker()
    from semantic_mapper.client import MapClient

    with MapClient(endpoint, timeout_s=TIMEOUT_S) as client:
        for ask in _questions(client, eyes, 0).values():
            ask()
        told.send(READY)
        turn = 0
        while _next_word(told) == ASK:
            turn += 1
            questions = _questions(client, eyes, turn)
            told.send(ASKING)
            told.send(_ask_evenly(told, questions, 1 / rate_hz))


def _next_word(told: Connection) -> str:
    try:
        return told.recv()
    except EOFError:
        return ""


def _ask_evenly(told: Connection, questions: dict[str, Callable[[], object]], period_s: float) -> list[Asked]:
    """One kind after another until the next word comes."""
    asked: list[Asked] = []
    due = time.perf_counter()
    while not told.poll(max(0.0, due - time.perf_counter())):
        kind = KINDS[len(asked) % len(KINDS)]
        began = time.perf_counter()
        questions[kind]()
        ended = time.perf_counter()
        asked.append(Asked(kind, (ended - began) * 1e3))
        due = max(due + period_s, ended)
    _next_word(told)
    return asked


def _questions(client: MapClient, eyes: Float64, seed: int) -> dict[str, Callable[[], object]]:
    """What to ask, by kind: about other places each time, all of them seen in the map as it is now."""
    import numpy as np

    rng = np.random.default_rng(seed)
    labels = client.info().label_set
    origins, directions = eyes[rng.integers(len(eyes), size=RAYS)], rng.normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = client.cast_rays(origins, directions, MAX_RAY_M)
    rays = np.flatnonzero((hits.distance_m > 0) & (hits.label != labels.ignore_id))
    names = dict(zip(labels.ids, labels.names, strict=True))
    client.mirror()  # of what follows, only changes are fetched

    def ray() -> int:
        return int(rng.choice(rays))

    def on_the_way(i: int, fraction: float) -> Float64:
        return origins[i] + fraction * float(hits.distance_m[i]) * directions[i]

    def box() -> object:
        centre = origins[ray()]
        return client.distance_field(centre - BOX_M / 2, centre + BOX_M / 2)

    return {
        "at": lambda: client.at([on_the_way(ray(), 1.0)]),
        "nearest": lambda: client.nearest(names[int(hits.label[ray()])], origins[ray()]),
        "cast_rays": lambda: client.cast_rays([origins[i := ray()]], [directions[i]], MAX_RAY_M),
        "occupancy": lambda: client.occupancy([on_the_way(ray(), rng.random())]),
        "distance_field": box,
        "instances": client.instances,
        "changes": client.mirror,
    }
