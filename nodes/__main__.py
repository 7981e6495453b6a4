"""The process of a node: ``python -m semantic_mapper.nodes KIND JOB``."""

import pkgutil
import sys

from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import OPTIONS, NodeOptions

WORK = {
    "camera": "semantic_mapper.nodes.camera.node:run_camera",
    "mapper": "semantic_mapper.nodes.mapper.node:run_mapper",
    "recorder": "semantic_mapper.nodes.recorder.node:run_recorder",
    "finetuner": "semantic_mapper.nodes.finetuner.process:run",
    "foxglove": "semantic_mapper.nodes.foxglove.node:run_foxglove",
}


def main() -> None:
    """Be a node of a kind."""
    kind = sys.argv.pop(1) if len(sys.argv) > 1 else ""
    if kind not in WORK:
        sys.exit(f"no kind of node is called '{kind}'; there are {', '.join(WORK)}")

    def work(context: NodeContext, options: NodeOptions) -> str | None:
        return pkgutil.resolve_name(WORK[kind])(context, options)  # it may load torch: thread counts are set by now

    run_node(OPTIONS[kind], work)


if __name__ == "__main__":
    main()
