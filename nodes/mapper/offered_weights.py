"""Weights that a mapper was offered: what is known of them, and their files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, check_same_shape, load_checkpoint
from semantic_mapper.fields.learned import encode_alike
from semantic_mapper.files import atomic_path
from semantic_mapper.transport.messages import WeightsUpdate, digest_of
from semantic_mapper.transport.query_messages import WeightsEntry

FOLDER = "weights"  # beside the map
State = Literal["in use", "earlier", "refused", "rolled back"]


@dataclass(slots=True)
class OfferedWeights:
    """Weights that this mapper has been offered, or was started with."""

    number: int
    digest: str
    path: Path
    state: State
    score: float = 0.0
    parent_score: float = 0.0
    keyframes: int = 0
    reason: str = ""

    def entry(self) -> WeightsEntry:
        """As it is told to who asks."""
        return WeightsEntry(
            version=self.number,
            digest=self.digest,
            state=self.state,
            score=self.score,
            parent_score=self.parent_score,
            keyframes=self.keyframes,
            reason=self.reason[:512],
        )


def file_of_version(folder: Path, number: int) -> Path:
    """Where a mapper keeps weights."""
    return folder / f"{number:06d}.safetensors"


def find_kept(folder: Path, number: int, digest: str, like: Checkpoint) -> Checkpoint | None:
    """Weights that a mapper has kept; None where they are not there, or others are.

    Args:
        folder: Of the mapper's weights.
        digest: SHA-256 of the file that is meant.

    Raises:
        WeightsError: not weights that can take the place of ``like``.
        OSError: they cannot be read.
    """
    path = file_of_version(folder, number)
    if not path.exists() or digest_of(path.read_bytes()) != digest:
        return None
    return read_weights(path, like)


def read_offer(update: WeightsUpdate, path: Path, like: Checkpoint) -> Checkpoint:
    """Keep the file and read it; where it is no good, it is not kept.

    Raises:
        WeightsError: not weights that can take the place of ``like``.
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_bytes(update.data)
        return read_weights(part, like)


def read_weights(path: Path, like: Checkpoint) -> Checkpoint:
    """Read weights that can take the place of ``like`` in a pipeline that goes on.

    Raises:
        WeightsError: they cannot.
    """
    check_same_shape(path, like)
    checkpoint = load_checkpoint(path)
    if not encode_alike(checkpoint.model, like.model):
        raise WeightsError(
            f"{path.name}: its image encoder is another one, so that keyframes would have to be encoded anew; finetune "
            "with resting_share = 1"
        )
    return checkpoint
