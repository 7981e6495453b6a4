"""The command of research, in this process."""

from pathlib import Path
from subprocess import CompletedProcess

from research.cli.main import app
from tests.nodes import support


def run(*arguments: str | Path) -> CompletedProcess[str]:
    """``semantic-mapper-research`` with these arguments, to its end."""
    return support.run(*arguments, app=app)
