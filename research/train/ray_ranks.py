"""Training with its ranks under Ray Train: a lost rank restarts the group, which goes on with the last saved state."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import msgspec

from research.train.folder_lock import sole_use_of
from research.train.ranks import backend_for, ranks_from_environment
from research.train.room_actors import open_actor_feed
from research.train.train import STATE_FILE, TrainProgress, train
from research.train.train_checks import check_nothing_is_overwritten, check_settings
from research.train.train_config import TrainConfig
from research.train.train_state import unfinished_step
from semantic_mapper.errors import ConfigError, NodeError, SemanticMapperError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.log_events import get_logger
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.process import prepare_process

MAX_RESTARTS = 10  # of a group of ranks in one sitting; preemptions that Ray knows of do not count
POLL_S = 0.3  # between two looks at how far the ranks are
LOCK_WAIT_S = 60.0  # for the folder, which a lost rank may hold until its machine's file server notices

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class _RankResources:
    """What one rank takes of the cluster.

    Args:
        cpus: Cores, and threads of computation.
        gpu: Whether it has a GPU of its own.
    """

    cpus: int = 1
    gpu: bool = False


def train_on_ray(
    config: TrainConfig,
    folder: Path,
    *,
    ranks: int = 1,
    cpus_per_rank: int = 1,
    resume: bool = False,
    on_progress: Callable[[TrainProgress], None] | None = None,
    stopped: Callable[[], object] = bool,
) -> Checkpoint:
    """As ``training.train``, in ``ranks`` processes on the cluster that this process is connected with.

    When a rank is lost, all start again, as many as before, from the last state in ``folder``: up to
    ``config.save_every_s`` of work is repeated, and ends with the same weights and losses.

    Args:
        folder: A folder that this machine and those of all ranks share.
        ranks: Processes; each trains on its own rooms.
        cpus_per_rank: Cores of each, beside one for each of its ``config.workers`` actors that render rooms.
        stopped: Asked every ``POLL_S``.

    Raises:
        ConfigError: as of ``train``; or the cluster has too few cores or GPUs, or a rank does not see ``folder``.
        WeightsError: as of ``train``.
        NodeError: the ranks were lost too often.
    """
    check_settings(config)
    folder = folder.resolve()
    if resume:
        unfinished_step(folder / STATE_FILE)  # says what is wrong with it
    else:
        check_nothing_is_overwritten(folder / STATE_FILE)
    with sole_use_of(folder):  # says at once that another training is writing there
        pass
    resources = _resources(config, ranks, cpus_per_rank)
    placed = msgspec.structs.replace(
        config,
        device="cuda" if resources.gpu else "cpu",
        start=_absolute(config.start),
        encoder_from=_absolute(config.encoder_from),
    )
    with _marked(folder) as marker:
        coordinator: Any = _open_coordinator()
        task = _Task(placed, folder, marker, resume, coordinator)
        return _wait_for(_Fit(task, ranks, resources), coordinator, on_progress, stopped)


@dataclass(frozen=True, slots=True)
class _Task:
    """What each rank is given.

    Args:
        marker: A file in ``folder``, which shows that a rank sees this very folder.
        coordinator: Handle of the ``_Coordinator`` actor.
    """

    config: TrainConfig
    folder: Path
    marker: Path
    resume: bool
    coordinator: Any


class _Coordinator:
    """An actor on the driver's machine where ranks and driver meet."""

    def __init__(self) -> None:
        self._progress: TrainProgress | None = None
        self._stop = False
        self._starts = 0
        self._error: SemanticMapperError | None = None
        self._checkpoint: Checkpoint | None = None

    def start(self, first: bool) -> bool:
        """A rank begins; returns whether to go on: what an earlier group has refused, another would refuse again."""
        self._starts += first
        return self._error is None

    def report(self, progress: TrainProgress) -> bool:
        """How far the first rank is; returns whether it is to stop."""
        self._progress = progress
        return self._stop

    def refuse(self, error: SemanticMapperError) -> None:
        """Why a rank cannot go on."""
        self._error = self._error or error

    def finish(self, checkpoint: Checkpoint) -> None:
        """What training has come to."""
        self._checkpoint = checkpoint

    def look(self, stop: bool) -> tuple[TrainProgress | None, int]:
        """The driver's turn: whether ranks are to stop; returns how far they are, and how often they have started."""
        self._stop = stop
        return self._progress, self._starts

    def result(self) -> tuple[Checkpoint | None, SemanticMapperError | None]:
        """What was finished, and what was refused."""
        return self._checkpoint, self._error


class _ProgressReporter:
    """Reports from the first rank: one message under way at a time, so that no step waits for an answer."""

    def __init__(self, coordinator: Any) -> None:
        self._coordinator = coordinator
        self._answer: Any = None
        self.stop = False

    def report(self, progress: TrainProgress) -> None:
        import ray

        if self._answer is not None:
            if not ray.wait([self._answer], timeout=0)[0]:
                return
            self.stop = bool(ray.get(self._answer))
        self._answer = self._coordinator.report.remote(progress)


def _run_rank(setup: dict[str, Any]) -> None:
    """What each process of the group does."""
    import ray

    task: _Task = setup["task"]
    prepare_process()
    keep_freed_memory()
    ranks = ranks_from_environment()
    if not ray.get(task.coordinator.start.remote(ranks.first)):
        return
    try:
        if not task.marker.is_file():
            raise ConfigError(
                f"{task.folder}: rank {ranks.rank} on {ray.util.get_node_ip_address()} does not see this folder; give "
                "an --out that all machines of the cluster share (NFS, say)"
            )
        if ranks.first:
            _wait_for_lock(task.folder)
        # The driver has made sure that a state is of this run: there was none before, or --resume goes on with it.
        resume = task.resume or (task.folder / STATE_FILE).is_file()
        reporter = _ProgressReporter(task.coordinator)
        checkpoint = train(
            task.config,
            task.folder,
            resume=resume,
            on_progress=reporter.report,
            stopped=lambda: reporter.stop,
            feed=open_actor_feed,
        )
    except SemanticMapperError as error:
        ray.get(task.coordinator.refuse.remote(error))
        raise
    if ranks.first:
        ray.get(task.coordinator.finish.remote(checkpoint))


def _wait_for_lock(folder: Path) -> None:
    """Until no rank of a former group holds the folder.

    Raises:
        ConfigError: another training does, and goes on.
    """
    until = time.monotonic() + LOCK_WAIT_S
    while True:
        try:
            with sole_use_of(folder):
                return
        except ConfigError:
            if time.monotonic() > until:
                raise
            time.sleep(1)


class _Fit(threading.Thread):
    """Ray Train's blocking call, in a thread: in the main one it would take Ctrl-C for itself, and save nothing."""

    def __init__(self, task: _Task, ranks: int, resources: _RankResources) -> None:
        super().__init__(daemon=True)
        self._task, self._ranks, self._resources = task, ranks, resources
        self.error: Exception | None = None

    def run(self) -> None:
        from ray.exceptions import RayError
        from ray.train import FailureConfig, RunConfig, ScalingConfig, TrainingFailedError
        from ray.train.torch import TorchConfig, TorchTrainer

        gpus = int(self._resources.gpu)
        trainer = TorchTrainer(
            _run_rank,
            train_loop_config={"task": self._task},
            torch_config=TorchConfig(backend=backend_for("cuda" if gpus else "cpu")),
            scaling_config=ScalingConfig(
                num_workers=self._ranks,
                use_gpu=self._resources.gpu,
                resources_per_worker={"CPU": self._resources.cpus} | ({"GPU": gpus} if gpus else {}),
            ),
            run_config=RunConfig(
                name=self._task.marker.parent.name,
                storage_path=str(self._task.folder),
                failure_config=FailureConfig(max_failures=MAX_RESTARTS),
                worker_runtime_env={"env_vars": {"OMP_NUM_THREADS": str(self._resources.cpus)}},
            ),
        )
        try:
            trainer.fit()
        except (TrainingFailedError, RayError) as error:
            self.error = error


def _wait_for(
    fit: _Fit, coordinator: Any, on_progress: Callable[[TrainProgress], None] | None, stopped: Callable[[], object]
) -> Checkpoint:
    """Show progress and hand on a stop until the ranks have ended; returns their weights."""
    import ray

    fit.start()
    shown, starts = None, 1
    while fit.is_alive():
        fit.join(POLL_S)
        progress, started = ray.get(coordinator.look.remote(bool(stopped())))
        if started > starts:
            _log.warning("ranks_restarted", restarts=started - 1, step=0 if progress is None else progress.step)
            starts = started
        if on_progress is not None and progress is not None and progress != shown:
            on_progress(progress)
            shown = progress
    checkpoint, refused = ray.get(coordinator.result.remote())
    if refused is not None:
        raise refused
    if checkpoint is None:  # the first rank hands it in as the last thing that it does
        raise NodeError(
            f"training has ended after {starts} starts of its ranks: {fit.error}; --resume goes on from the last saved "
            "state"
        ) from fit.error
    return checkpoint


def _open_coordinator() -> Any:
    """A ``_Coordinator`` on this machine, so that it is lost with the driver alone."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    actor: Any = ray.remote(_Coordinator).options(num_cpus=0, scheduling_strategy=here)
    return actor.remote()


@contextmanager
def _marked(folder: Path) -> Iterator[Path]:
    """Meanwhile there is a file of a name of its own in a folder of its own in ``folder``, where Ray writes too."""
    place = folder / f".ray-{uuid4().hex}"
    place.mkdir(parents=True)
    marker = place / "shared"
    marker.touch()
    try:
        yield marker
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _resources(config: TrainConfig, ranks: int, cpus: int) -> _RankResources:
    """What each rank takes; a GPU where the config asks for one, or where ``auto`` finds enough of them.

    Raises:
        ConfigError: the cluster has less than all ranks and their actors take.
    """
    import ray

    there = ray.cluster_resources()
    have_cpus, have_gpus = int(there.get("CPU", 0)), int(there.get("GPU", 0))
    gpu = config.device == "cuda" or (config.device == "auto" and have_gpus >= ranks)
    wanted_cpus, wanted_gpus = ranks * (cpus + config.workers), ranks * gpu
    if wanted_cpus > have_cpus or wanted_gpus > have_gpus:
        raise ConfigError(
            f"{ranks} ranks with {config.workers} room actors each need {wanted_cpus} CPU cores and {wanted_gpus} "
            f"GPUs, the cluster has {have_cpus} and {have_gpus}; lower --ranks or --workers, or add machines"
        )
    return _RankResources(cpus, gpu)


def _absolute(path: str) -> str:
    """Ranks run in folders of Ray's."""
    return str(Path(path).resolve()) if path else ""
