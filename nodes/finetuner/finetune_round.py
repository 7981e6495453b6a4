"""One round of learning, in a thread of its own."""

from __future__ import annotations

import threading
import time
from concurrent.futures import CancelledError

import structlog

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.nodes.process import run_when_idle
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.keyframe_pool import KeyframeSplit
from semantic_mapper.training.online import OnlineResult, learn

_log = structlog.get_logger(__name__)


class FinetuneRound:
    """Begins at once, and rests after each step and each look at a held-out keyframe as its share says.

    Args:
        keyframes: To learn from, and to judge by.
        parent: Weights in use.
        parent_digest: SHA-256 of their file, hexadecimal.
        config: Of the round.
        fraction: Of a core, or of the GPU, in 0..1.
        idle: Learn only while nobody else wants the processor.
    """

    def __init__(
        self,
        keyframes: KeyframeSplit,
        parent: Checkpoint,
        parent_digest: str,
        config: OnlineConfig,
        fraction: float,
        *,
        idle: bool,
    ) -> None:
        self.parent_digest = parent_digest
        self.step = 0
        self.result: OnlineResult | None = None
        self.failure = "it failed; see the log"
        self._share = fraction
        self._clock = time.process_time if config.finetune.device == "cpu" else time.monotonic
        self._worked_from = self._clock()
        self._cancelled = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(keyframes, parent, config, idle), name="learning", daemon=True
        )
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether there is no outcome yet."""
        return self._thread.is_alive()

    @property
    def cancelled(self) -> bool:
        """Whether nobody wants the outcome any more."""
        return self._cancelled.is_set()

    def cancel(self) -> None:
        """Ask it to end after the step that it is in."""
        self._cancelled.set()

    def has_ended(self, timeout_s: float) -> bool:
        """Whether it ends within this time."""
        self._thread.join(timeout_s)
        return not self.running

    def _run(self, keyframes: KeyframeSplit, parent: Checkpoint, config: OnlineConfig, idle: bool) -> None:
        import torch

        torch.set_num_threads(torch.get_num_threads())  # OpenMP has a limit for each thread
        if idle:
            run_when_idle()
        try:
            self.result = learn(keyframes, parent, config, self._on_progress, self._rest)
        except CancelledError:
            _log.info("round_given_up", reason="the mapper uses other weights now")
        except SemanticMapperError as error:
            self.failure = str(error)
        except (MemoryError, RuntimeError) as error:  # torch raises a RuntimeError where memory is exhausted
            lines = str(error).strip().splitlines()
            self.failure = f"{type(error).__name__}: {lines[0] if lines else 'no more is known'}"

    def _on_progress(self, progress: FitProgress) -> None:
        self.step = progress.step
        self._rest()

    def _rest(self) -> None:
        worked_s = self._clock() - self._worked_from
        if self._cancelled.wait(worked_s / self._share - worked_s):
            raise CancelledError
        self._worked_from = self._clock()
