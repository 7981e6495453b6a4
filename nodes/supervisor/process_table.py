"""The kinds of node processes, one row each. A launch file says which of them run, and when they restart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class ProcessKind:
    """How a kind of node is started and stopped.

    Attributes:
        module: With ``main(job)``.
        preloaded: Forked from a process that has imported PyTorch and Open3D, which take seconds.
        ends_with_stream: Ends by itself when the stream does; otherwise it is asked to.
        stop_limit: Field of the launch file that bounds how long it may take to end.
    """

    module: str
    preloaded: bool
    ends_with_stream: bool
    stop_limit: Literal["stop_s", "finish_s"]


_NODES = "semantic_mapper.nodes"
# In the order in which they are stopped: sources first, so that the others get the end of the stream.
PROCESS_TABLE: dict[str, ProcessKind] = {
    "camera": ProcessKind(f"{_NODES}.camera.node", preloaded=False, ends_with_stream=True, stop_limit="stop_s"),
    "finetuner": ProcessKind(f"{_NODES}.finetuner.node", preloaded=True, ends_with_stream=False, stop_limit="finish_s"),
    "foxglove": ProcessKind(f"{_NODES}.foxglove.node", preloaded=True, ends_with_stream=True, stop_limit="stop_s"),
    "zenoh": ProcessKind(f"{_NODES}.zenoh.node", preloaded=True, ends_with_stream=True, stop_limit="stop_s"),
    "recorder": ProcessKind(f"{_NODES}.recorder.node", preloaded=False, ends_with_stream=True, stop_limit="stop_s"),
    "mapper": ProcessKind(f"{_NODES}.mapper.__main__", preloaded=True, ends_with_stream=True, stop_limit="finish_s"),
}
