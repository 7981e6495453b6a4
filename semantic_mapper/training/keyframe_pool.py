"""Labelled keyframes that come one by one: which to learn from, which to judge by, and which have been validated."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import PosedFrame

Key = tuple[str, int]  # camera_id, stamp_ns
MAX_TRIALS = 3  # rounds without success that a keyframe may take part in before it is dropped


@dataclass(frozen=True, slots=True)
class KeyframeSplit:
    """The keyframes of one round.

    Args:
        train: Labelled keyframes to learn from.
        held_out: Labelled keyframes that are never learned from.
        validated: Keys of those with which the weights in use were found better.
    """

    train: tuple[PosedFrame, ...]
    held_out: tuple[PosedFrame, ...]
    validated: frozenset[Key] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A keyframe of the pool.

    Args:
        frame: With labels in the classes of the pool.
        held_out: Whether it is never learned from.
        validated_by: Version of the first weights that were taken after a round with it; None = none yet.
        trials: Rounds without success since it came.
    """

    frame: PosedFrame
    held_out: bool
    validated_by: int | None = None
    trials: int = 0


class KeyframePool:
    """A bounded set of labelled keyframes in the classes of one label set.

    Args:
        label_set: Of the weights.
        held_out_every: Of this many keyframes, the last one is held out, for good.
        capacity: Keyframes kept; past it the oldest is dropped.
    """

    def __init__(self, label_set: LabelSet, *, held_out_every: int, capacity: int) -> None:
        self._label_set = label_set
        self._held_out_every = held_out_every
        self._capacity = capacity
        self._kept: dict[Key, Kept] = {}
        self._received = 0

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def new(self) -> int:
        """Keyframes that have not been in a round."""
        return sum(k.validated_by is None and not k.trials for k in self._kept.values())

    @property
    def kept(self) -> tuple[Kept, ...]:
        """All, the oldest first."""
        return tuple(self._kept.values())

    def add(self, frame: PosedFrame, label_set: LabelSet) -> None:
        """Add a keyframe; one of the same camera and time is replaced, and no longer validated.

        Args:
            frame: With labels.
            label_set: Of these; classes are translated by name, those that the weights lack are not learned.

        Raises:
            FrameError, PoseError, LabelError: it cannot be learned from; nothing has changed.
        """
        frame = self._translated(frame, label_set)
        before = self._kept.pop(key_of(frame), None)
        self._received += before is None
        self._put(Kept(frame, self._received % self._held_out_every == 0 if before is None else before.held_out))

    def restore(self, kept: Kept, label_set: LabelSet) -> None:
        """Add a keyframe of an earlier pool with its state there; the oldest first.

        Raises:
            FrameError, PoseError, LabelError: it cannot be learned from; nothing has changed.
        """
        kept = replace(kept, frame=self._translated(kept.frame, label_set))
        self._received += 1
        self._put(kept)

    def split(self) -> KeyframeSplit:
        """The keyframes of a round that begins now."""
        return KeyframeSplit(
            tuple(k.frame for k in self.kept if not k.held_out),
            tuple(k.frame for k in self.kept if k.held_out),
            frozenset(key for key, k in self._kept.items() if k.validated_by is not None),
        )

    def validate(self, keys: Collection[Key], version: int) -> None:
        """Weights of a round with these keyframes are in use."""
        for key in self._not_validated(keys):
            self._kept[key] = replace(self._kept[key], validated_by=version, trials=0)

    def reject(self, keys: Collection[Key], *, worse: bool) -> int:
        """A round with these keyframes had no success: those not validated get ``MAX_TRIALS`` such rounds.

        Args:
            keys: Of the round.
            worse: It made the weights worse: those not validated are dropped at once.

        Returns:
            How many were dropped.
        """
        for key in self._not_validated(keys):
            trials = MAX_TRIALS if worse else self._kept[key].trials + 1
            self._kept[key] = replace(self._kept[key], trials=trials)
        return self._drop(lambda k: k.trials >= MAX_TRIALS)

    def return_to(self, version: int) -> int:
        """Drop what was validated by later weights alone, after a roll-back; returns how many."""
        return self._drop(lambda k: k.validated_by is not None and k.validated_by > version)

    def _not_validated(self, keys: Collection[Key]) -> list[Key]:
        return [key for key in keys if key in self._kept and self._kept[key].validated_by is None]

    def _put(self, kept: Kept) -> None:
        self._kept[key_of(kept.frame)] = kept
        if len(self._kept) > self._capacity:
            del self._kept[next(iter(self._kept))]

    def _drop(self, condition: Callable[[Kept], bool]) -> int:
        before = len(self._kept)
        self._kept = {key: kept for key, kept in self._kept.items() if not condition(kept)}
        return before - len(self._kept)

    def _translated(self, frame: PosedFrame, label_set: LabelSet) -> PosedFrame:
        where = f"keyframe seq={frame.seq} of camera '{frame.camera_id}'"
        check_pose(frame.T_world_camera, where)
        if frame.label is None:
            raise FrameError(f"{where}: has no label image")
        label_set.to_channels(frame.label, where)  # refuses ids that its own label set lacks
        label = self._label_set.to_ids(self._label_set.channel_map_from(label_set))[frame.label]
        if not (label != self._label_set.ignore_id).any():
            raise FrameError(
                f"{where}: none of its pixels is of a class that the weights know; they know "
                f"{', '.join(self._label_set.names)}"
            )
        size, first = _size(frame), next(iter(self._kept.values()), None)
        if first is not None and size != _size(first.frame):
            raise FrameError(
                f"{where}: {size[0]}x{size[1]} pixels, but those before have "
                f"{'x'.join(map(str, _size(first.frame)))}; keyframes must be of one size"
            )
        return replace(frame, label=label)


def key_of(frame: PosedFrame) -> Key:
    """What tells a keyframe from all others."""
    return frame.camera_id, frame.stamp_ns


def _size(frame: PosedFrame) -> tuple[int, int]:
    return frame.intrinsics.width, frame.intrinsics.height
