"""``semantic-mapper compare``: do two runs of one log come to the same?"""

from __future__ import annotations

import filecmp
from pathlib import Path

from semantic_mapper.config import AtLeastZero
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOutput, verb, wrong_usage
from semantic_mapper.replay.compare import Difference, Tolerances, compare_runs, read_run
from semantic_mapper.replay.run_folder import map_path

_DEFAULT = Tolerances()


@verb
def compare(
    output: JsonOutput,
    a: Path,  # folder that `map` or `up` has written, or a map.npz
    b: Path,  # another one
    *,
    score: AtLeastZero = _DEFAULT.score,  # allowed of mIoU and accuracies
    surface_m: AtLeastZero = _DEFAULT.surface_m,  # allowed distance of the surfaces, metres
    labels: AtLeastZero = _DEFAULT.labels,  # allowed fraction of points with another class
    exact: bool = False,  # the maps must be the same, byte for byte
) -> int:
    """Compare two results of one log: scores and surfaces.

    Exit codes: 0 equal, 1 different, 2 wrong usage, or something that cannot be read.

    Example: semantic-mapper compare runs/before runs/after
    Example: semantic-mapper compare runs/before runs/after --labels 0.05
    Example: semantic-mapper compare a/map.npz b/map.npz --exact --json
    """
    tolerances = Tolerances(score=score, surface_m=surface_m, labels=labels)
    with wrong_usage(SemanticMapperError):
        comparison = compare_runs(read_run(a), read_run(b), tolerances)
        if exact:
            other = 0 if filecmp.cmp(map_path(a), map_path(b), shallow=False) else 1
            comparison.figures.append(Difference("other bytes", None, None, other))
    for line in (*comparison.figures, *comparison.notes):
        output.print(str(line))
    different = ", ".join(figure.name for figure in comparison.differences)
    output.print(f"different: {different}" if different else "equal")
    output.json({"a": str(a), "b": str(b), **comparison.to_plain()})
    return 0 if comparison.equal else EXIT_FAILED
