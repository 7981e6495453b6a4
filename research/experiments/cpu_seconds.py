"""Run a verb, or a module, whose budgets of seconds are its own processor time: for a machine that is shared.

python -m research.experiments.cpu_seconds semantic-mapper-research suite rooms --protocol finetune --seconds 60
python -m research.experiments.cpu_seconds research.experiments.taught_rooms --out runs/taught.jsonl
"""

from __future__ import annotations

import importlib
import runpy
import sys
import time


def main() -> None:
    """Put processor time in the place of the clock, one thread of torch, and run."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    time.monotonic = time.process_time
    import torch

    torch.set_num_threads(1)
    sys.argv = sys.argv[1:]
    verbs = {"semantic-mapper": "semantic_mapper.nodes.cli.main", "semantic-mapper-research": "research.cli.main"}
    if sys.argv[0] in verbs:
        sys.exit(importlib.import_module(verbs[sys.argv[0]]).main())
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
