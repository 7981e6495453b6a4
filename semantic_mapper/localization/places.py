"""Which of the places seen so far an image shows: candidates for a loop closure, or for a relocalisation.

Matches are counted with each place in turn (2 ms each), which is exact and needs no vocabulary; a few hundred places
are as many as a map keeps.
"""

from __future__ import annotations

from semantic_mapper.localization.features import Features, match_features
from semantic_mapper.types import UInt8


class PlaceIndex:
    """Descriptors of places, by number. Deterministic.

    Args:
        capacity: Places that are kept; one more takes the place of the oldest.
    """

    def __init__(self, capacity: int = 300) -> None:
        self._capacity = capacity
        self._descriptors: dict[int, UInt8] = {}

    def __len__(self) -> int:
        return len(self._descriptors)

    @property
    def keys(self) -> tuple[int, ...]:
        """Of the places that are kept, oldest first."""
        return tuple(self._descriptors)

    def add(self, key: int, features: Features) -> None:
        """Keep a place; one of the same key is replaced. Features without depth count, too."""
        self._descriptors.pop(key, None)
        self._descriptors[key] = features.descriptors
        if len(self._descriptors) > self._capacity:
            del self._descriptors[next(iter(self._descriptors))]

    def remove(self, key: int) -> None:
        """Forget a place, if it is there."""
        self._descriptors.pop(key, None)

    def candidates(
        self, features: Features, count: int, exclude: frozenset[int] = frozenset()
    ) -> list[tuple[int, int]]:
        """The places most like an image, best first, as (key, number of features that match); older first if equal.

        Args:
            features: Of the image (``find_place_features``), as those that were added.
            count: At most this many, each with at least one match.
            exclude: Keys that do not count, such as those of the last seconds.
        """
        scored: list[tuple[int, int]] = []
        for key, descriptors in self._descriptors.items():
            if key not in exclude:
                scored.append((key, len(match_features(features.descriptors, descriptors))))
        scored.sort(key=lambda item: -item[1])
        return [(key, score) for key, score in scored[:count] if score > 0]
