"""``semantic-mapper compare``: do two runs of one log come to the same?"""

from pathlib import Path

from semantic_mapper.config import AtLeastZero
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOutput, verb, wrong_usage
from semantic_mapper.replay.compare import Tolerances, compare_runs, read_run

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
) -> int:
    """Compare two results of one log: scores and surfaces.

    Exit codes: 0 equal, 1 different, 2 wrong usage, or something that cannot be read.

    Example: semantic-mapper compare runs/before runs/after
    Example: semantic-mapper compare runs/before runs/after --labels 0.05
    """
    tolerances = Tolerances(score=score, surface_m=surface_m, labels=labels)
    with wrong_usage(SemanticMapperError):
        comparison = compare_runs(read_run(a), read_run(b), tolerances)
    for line in (*comparison.figures, *comparison.notes):
        output.print(str(line))
    different = ", ".join(figure.name for figure in comparison.differences)
    output.print(f"different: {different}" if different else "equal")
    output.json({"a": str(a), "b": str(b), **comparison.to_plain()})
    return 0 if comparison.equal else EXIT_FAILED
