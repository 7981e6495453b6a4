"""One round of learning in a thread of its own, within a share of a core."""

from __future__ import annotations

import tempfile
import threading
import time
from pathlib import Path

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.nodes.finetuner.throttle import AbandonedError, Throttle, run_again, run_when_idle
from semantic_mapper.training.finetune import FinetuneProgress
from semantic_mapper.training.keyframe_pool import Lessons, key_of
from semantic_mapper.training.online import Lesson, OnlineConfig, learn


class LearningRound:
    """Begins at once.

    Args:
        lessons: To learn from, and to judge by.
        parent: Weights in use; ``digest`` is that of their file.
        config: Of the round.
        share: Of a core, or of the GPU.
        idle: Learn only while nobody else wants the processor.
    """

    def __init__(
        self,
        lessons: Lessons,
        parent: Checkpoint,
        digest: str,
        config: OnlineConfig,
        share: float,
        *,
        idle: bool = False,
    ) -> None:
        self.digest = digest
        self.step = 0
        self.lesson: Lesson | None = None
        self.failure = "it failed; see the log"
        self.abandoned = False
        self.keys = frozenset(key_of(f) for f in (*lessons.train, *lessons.held_out))
        self._began = time.monotonic()
        clock = time.process_time if config.finetune.device == "cpu" else time.monotonic
        self._throttle = Throttle(share, clock)
        self._work = lessons, parent, config
        self._idle = idle
        self._thread = threading.Thread(target=self._learn, name="learning", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether there is no outcome yet."""
        return self._thread.is_alive()

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began

    @property
    def rested_s(self) -> float:
        """Of these, those in which it did nothing."""
        return self._throttle.rested_s

    def abandon(self) -> None:
        """Give it up: it ends with the layer that it is in, which takes long where it gets no processor."""
        self._throttle.abandon()
        run_again(self._thread)

    def has_ended(self, timeout_s: float) -> bool:
        """Whether it ends within this time."""
        self._thread.join(timeout_s)
        return not self.running

    def _learn(self) -> None:
        import torch

        lessons, parent, config = self._work
        torch.set_num_threads(torch.get_num_threads())  # OpenMP has a limit for each thread
        if self._idle:
            run_when_idle()
        try:
            with self._throttle.pacing():
                self.lesson = learn(lessons, parent, config, self._on_progress)
        except AbandonedError:
            self.abandoned, self.failure = True, "given up: the mapper has gone on to other weights"
        except SemanticMapperError as error:
            self.failure = str(error)
        except (MemoryError, RuntimeError) as error:  # torch says in a RuntimeError that it has no memory
            lines = str(error).strip().splitlines()
            self.failure = f"{type(error).__name__}: {lines[0] if lines else 'no more is known'}"

    def _on_progress(self, progress: FinetuneProgress) -> None:
        self.step = progress.step


def file_of(checkpoint: Checkpoint) -> bytes:
    """The weights file of a checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "weights.safetensors"
        save_checkpoint(checkpoint, path)
        return path.read_bytes()
