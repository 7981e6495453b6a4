"""A robot that looks for a thing: it follows the map of a running mapper, and asks it where to go."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.client import MapClient
from semantic_mapper.queries.nearest import NearestSurface
from semantic_mapper.queries.occupancy import State
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import NewestSubscriber
from semantic_mapper.types import MapUpdate

STAND_OFF_M = 0.4  # where the robot stops before what it looks for
SILENCE_S = 120.0


@dataclass(frozen=True)
class Sighting:
    """Where the nearest thing is once the map has frame ``seq``; ``goal`` is the place before it, None = not found."""

    seq: int
    blocks: int
    distance_m: float | None
    goal: NDArray[np.float64] | None
    is_free: bool


def goal_before(found: NearestSurface, position: ArrayLike) -> NDArray[np.float64]:
    """The point (3,) on the way from ``position`` to what was found, ``STAND_OFF_M`` before it."""
    way = np.asarray(position, np.float64) - found.xyz
    return found.xyz + way * min(1.0, STAND_OFF_M / max(found.distance_m, 1e-6))


def sightings(class_name: str, position: ArrayLike, updates: str, questions: str = "live") -> Iterator[Sighting]:
    """Ask after each update of the map, until the mapper ends or falls silent.

    Args:
        class_name: What to look for.
        position: (3,) of the robot, world metres.
        updates: Endpoint that the mapper publishes at.
        questions: Where it answers, as of ``MapClient``; by default the launch that runs here.
    """
    with NewestSubscriber(updates, ("map", "status")) as mapper, MapClient(questions) as client:
        while True:
            message = mapper.receive(SILENCE_S)
            if message is None or (isinstance(message, Status) and message.state in ("stopping", "ended")):
                return
            if not isinstance(message, MapUpdate):
                continue
            found = client.nearest(class_name, position)
            if found is None:
                yield Sighting(message.seq, message.blocks, None, None, False)
                continue
            goal = goal_before(found, position)
            is_free = bool(client.occupancy([goal])[0] == State.FREE)
            yield Sighting(message.seq, message.blocks, found.distance_m, goal, is_free)


def main() -> None:
    """Tell what is seen, a line for each update."""
    parser = argparse.ArgumentParser(description="Follow a map and look for the nearest thing of a class.")
    parser.add_argument("class_name", metavar="CLASS")
    parser.add_argument("position", nargs=3, type=float, metavar=("X", "Y", "Z"), help="of the robot, metres")
    # By default those of a mapper that was started by hand; one of a launch has them where its launch file says.
    parser.add_argument("--updates", metavar="ENDPOINT", default=default_endpoint("mapper"), help="it publishes at")
    parser.add_argument("--questions", metavar="PLACE", default=default_endpoint("query"), help="it answers at")
    given = parser.parse_args()
    print(f"following {given.updates}", flush=True)
    for seen in sightings(given.class_name, given.position, given.updates, given.questions):
        if seen.goal is None:
            print(f"frame {seen.seq}: {seen.blocks} blocks, no {given.class_name} yet", flush=True)
            continue
        place = " ".join(f"{x:.2f}" for x in seen.goal)
        state = "free" if seen.is_free else "not known to be free"
        what = f"{given.class_name} at {seen.distance_m:.2f} m"
        print(f"frame {seen.seq}: {seen.blocks} blocks, {what}; {place} is {state}", flush=True)


if __name__ == "__main__":
    main()
