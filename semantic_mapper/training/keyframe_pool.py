"""Labelled keyframes that come one by one: which to learn from, which to judge by, and which have proved right."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import PosedFrame

Key = tuple[str, int]  # camera_id, stamp_ns
MAX_TRIALS = 3  # rounds in which a keyframe may take part without proving right, before it is forgotten


@dataclass(frozen=True, slots=True)
class Lessons:
    """What there is to learn at one moment.

    Args:
        train: Labelled keyframes to learn from.
        held_out: Those that are never learned from.
        proved: Keys of the keyframes with which the weights in use were found good.
    """

    train: tuple[PosedFrame, ...]
    held_out: tuple[PosedFrame, ...]
    proved: frozenset[Key]


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A keyframe of the pool.

    Args:
        frame: With labels in the classes of the pool.
        held_out: Whether it is never learned from.
        proved_at: Version of the weights with which it was first found good; None = with none yet.
        trials: Rounds that it took part in since, and that came to nothing.
    """

    frame: PosedFrame
    held_out: bool
    proved_at: int | None = None
    trials: int = 0


class KeyframePool:
    """A bounded set of labelled keyframes in the classes of one label set.

    Args:
        label_set: Of the weights.
        held_out_every: Of so many keyframes, the last one is held out, for good.
        capacity: Keyframes kept; past it the oldest goes.
    """

    def __init__(self, label_set: LabelSet, *, held_out_every: int, capacity: int) -> None:
        self._label_set = label_set
        self._held_out_every = held_out_every
        self._capacity = capacity
        self._kept: dict[Key, Kept] = {}
        self._taken = 0  # of all that ever came, so that every so many is held out

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def new(self) -> int:
        """Keyframes that nothing has been learned from, nor tried to be."""
        return sum(k.proved_at is None and not k.trials for k in self._kept.values())

    @property
    def kept(self) -> tuple[Kept, ...]:
        """All, the oldest first."""
        return tuple(self._kept.values())

    def add(self, frame: PosedFrame, label_set: LabelSet) -> None:
        """Take a keyframe; one of the same camera and time takes the place of the one before, and has to prove itself.

        Args:
            frame: With labels.
            label_set: Of these; classes are translated by name, those that the weights lack are not learned.

        Raises:
            FrameError, PoseError, LabelError: it cannot be learned from; nothing has changed.
        """
        frame = self._translated(frame, label_set)
        key = key_of(frame)
        before = self._kept.pop(key, None)
        if before is None:
            self._taken += 1
        held_out = self._taken % self._held_out_every == 0 if before is None else before.held_out
        self._put(key, Kept(frame, held_out))

    def restore(self, kept: Kept, label_set: LabelSet) -> None:
        """Take a keyframe of an earlier pool as it was there; from the oldest one on.

        Raises:
            FrameError, PoseError, LabelError: it cannot be learned from; nothing has changed.
        """
        self._taken += 1
        self._put(key_of(kept.frame), replace(kept, frame=self._translated(kept.frame, label_set)))

    def lessons(self) -> Lessons:
        """All that there is now."""
        kept = self._kept.values()
        return Lessons(
            tuple(k.frame for k in kept if not k.held_out),
            tuple(k.frame for k in kept if k.held_out),
            frozenset(key for key, k in self._kept.items() if k.proved_at is not None),
        )

    def prove(self, keys: Collection[Key], version: int) -> None:
        """Weights that were made and judged with these are in use."""
        for key in keys:
            if key in self._kept and self._kept[key].proved_at is None:
                self._kept[key] = replace(self._kept[key], proved_at=version, trials=0)

    def try_again(self, keys: Collection[Key]) -> int:
        """Keep those that came to nothing this time for rounds with further ones, but not for ever.

        Returns:
            How many are forgotten, since this was not their first round.
        """
        tried = [key for key in keys if key in self._kept and self._kept[key].proved_at is None]
        for key in tried:
            self._kept[key] = replace(self._kept[key], trials=self._kept[key].trials + 1)
        return self._drop([key for key in tried if self._kept[key].trials >= MAX_TRIALS])

    def set_aside(self, keys: Collection[Key]) -> int:
        """Forget those of these keyframes that have not proved right; returns how many."""
        return self._drop({key for key in keys if key in self._kept and self._kept[key].proved_at is None})

    def return_to(self, version: int) -> int:
        """Forget what proved right with later weights alone; returns how many. What is new stays."""
        return self._drop({key for key, k in self._kept.items() if k.proved_at is not None and k.proved_at > version})

    def _put(self, key: Key, kept: Kept) -> None:
        self._kept[key] = kept
        if len(self._kept) > self._capacity:
            del self._kept[next(iter(self._kept))]

    def _drop(self, keys: Collection[Key]) -> int:
        for key in keys:
            del self._kept[key]
        return len(keys)

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
