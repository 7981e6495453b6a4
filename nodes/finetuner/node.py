"""The process of a finetuner: sockets, priority, weights to start from. ``finetuner.py`` has what it does."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NoReturn

import structlog

from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import FinetunerOptions, NodeJob

MAX_WAITING = 8  # keyframes, of about half a megabyte each, and of 64 MiB at the most

_log = structlog.get_logger(__name__)


def run_finetuner(context: NodeContext, options: FinetunerOptions) -> None:
    """Learn until a stop request.

    Raises:
        ConfigError, WeightsError: it cannot start.
        TransportError: an endpoint is taken.
    """
    _lower_priority(options)
    from semantic_mapper.config import load_config
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, find_checkpoint, load_checkpoint
    from semantic_mapper.memory import keep_freed_memory
    from semantic_mapper.nodes.finetuner.finetuner import Finetuner
    from semantic_mapper.training.config import OnlineConfig
    from semantic_mapper.transport.messages import digest_of
    from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

    keep_freed_memory()
    config = load_config(Path(options.config), OnlineConfig) if options.config else OnlineConfig()
    path = find_checkpoint(Path(options.weights)) if options.weights else default_checkpoint_path()
    start, digest = load_checkpoint(path), digest_of(path.read_bytes())
    endpoint = options.labels if "://" in options.labels else context.endpoint(options.labels)
    with (
        Publisher(context.endpoint(context.name), hwm=2) as publisher,
        LosslessSubscriber(endpoint, ("keyframe",), hwm=MAX_WAITING) as labels,
        LosslessSubscriber(context.endpoint(options.mapper), ("in_use",)) as mapper,
    ):
        _log.info("ready", weights=path.name, labels=endpoint, fraction=options.cpu_fraction)
        finetuner = Finetuner(context, options, config, publisher, labels, mapper, start, digest)
        context.heartbeat.ready()
        finetuner.run()
        context.heartbeat.ending()
        finetuner.close()


def _lower_priority(options: FinetunerOptions) -> None:
    """Before anything computes: threads that are started then inherit this."""
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    os.setpriority(os.PRIO_PROCESS, 0, max(options.niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    import torch

    torch.set_num_threads(options.threads)  # a forked process has read the variable before


def main(job: NodeJob | None = None) -> NoReturn:
    """Run the node of this process to its end, then exit."""
    run_node(FinetunerOptions, run_finetuner, job)
