"""The process of a finetuner: its priority and its threads. ``finetuner.py`` has what it does."""

import os

from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import FinetunerOptions


def run(context: NodeContext, options: FinetunerOptions) -> None:
    """Learn until a stop request, with the threads and the priority of the options, which threads inherit."""
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    os.setpriority(os.PRIO_PROCESS, 0, max(options.niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    import torch

    from semantic_mapper.nodes.finetuner import finetuner  # loads torch, in the threads that were set

    torch.set_num_threads(options.threads)
    finetuner.run_finetuner(context, options)
