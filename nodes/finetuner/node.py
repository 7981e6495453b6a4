"""The process of a finetuner: its priority and its threads. ``finetuner.py`` has what it does."""

from __future__ import annotations

import os
from typing import NoReturn

from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import FinetunerOptions, NodeJob


def run_finetuner(context: NodeContext, options: FinetunerOptions) -> None:
    """Learn until a stop request.

    Raises:
        ConfigError, WeightsError: it cannot start.
        TransportError: an endpoint is taken.
    """
    _lower_priority(options)
    from semantic_mapper.nodes.finetuner import finetuner  # loads torch, in the threads that were set

    finetuner.run_finetuner(context, options)


def _lower_priority(options: FinetunerOptions) -> None:
    """Before anything computes: threads that are started then inherit this."""
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    os.setpriority(os.PRIO_PROCESS, 0, max(options.niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    import torch

    torch.set_num_threads(options.threads)  # a forked process has read the variable before


def main(job: NodeJob | None = None) -> NoReturn:
    """Run the node of this process to its end, then exit."""
    run_node(FinetunerOptions, run_finetuner, job)
