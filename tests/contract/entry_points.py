"""The command in this process and in one of its own, and a saved map that answers at a socket."""

import io
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import typer.main
from typer.testing import CliRunner

from semantic_mapper.client import MapClient
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli import main as cli
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.mapper.query_service import QueryService

REPOSITORY = Path(__file__).resolve().parents[2]
COMMAND = Path(sys.executable).parent / "semantic-mapper"
TIMEOUT_S = 300.0  # kernels may have to be compiled, on a busy machine


@dataclass(frozen=True)
class Ran:
    """A command that has come to its end; ``stdout`` holds results alone, ``stderr`` all that click and logs said."""

    code: int
    stdout: str
    stderr: str


def run_here(*arguments: str | Path) -> Ran:
    """The command in this process."""
    stdout = io.StringIO()
    with patch.object(Output, "guarded", lambda: Output(stdout)):
        done = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    return Ran(done.exit_code, stdout.getvalue(), done.output)


def run_command(*arguments: str | Path) -> Ran:
    """The installed command, in a process of its own."""
    done = subprocess.run(
        [str(COMMAND), *map(str, arguments)], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    return Ran(done.returncode, done.stdout, done.stderr)


def command_tree() -> Any:
    """The click command that holds all verbs."""
    return typer.main.get_command(cli.app)


def verb_of(name: str) -> Any:
    """The click command of a verb."""
    return command_tree().get_command(None, name)


@contextmanager
def short_folder() -> Iterator[Path]:
    """A folder for sockets, whose paths are short."""
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        yield Path(folder)


@contextmanager
def serving(path: Path, endpoint: str) -> Iterator[MapClient]:
    """Query a saved map through a socket."""
    stop = threading.Event()
    with QueryService(endpoint, VoxelMap.load(path)) as service:

        def follow() -> None:
            while not stop.wait(0.002):
                service.follow()

        mapper = threading.Thread(target=follow)
        mapper.start()
        try:
            with MapClient(endpoint) as client:
                yield client
        finally:
            stop.set()
            mapper.join()
