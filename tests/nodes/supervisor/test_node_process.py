"""What a launcher tells a node reaches that node alone; a real process."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.node import read_job
from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.supervisor.node_process import NodeProcess

WORD = "a-word-that-others-must-not-read"


def test_a_job_is_seen_by_its_node_and_in_no_list_of_processes(tmp_path: Path) -> None:
    long = "x" * 200_000  # more than one argument or a pipe holds
    child = NodeProcess(
        "camera", NodeJob(name="eye", options={"log": f"{tmp_path}/{WORD}.mcap"}, endpoints={"other": long})
    )
    try:
        for name in ("cmdline", "environ"):
            assert WORD not in Path(f"/proc/{child.pid}/{name}").read_text(errors="replace")
        assert child.wait(60)
        assert WORD in child.describe_end(), "it was told where its log is"
    finally:
        child.close()


@pytest.mark.parametrize("argument", ["fd:99999", "fd:none", "fd:", "{", ""])
def test_an_argument_that_is_no_job_is_refused(argument: str) -> None:
    with pytest.raises(ConfigError, match="must be JSON, or fd:N"):
        read_job(argument)
