"""Run a command while other processes keep the processors busy: ``python -m tools.beside_load 2 COMMAND...``.

The busy processes end with the command, whatever ends it, and with this process if that is killed. The exit code is
the command's.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

# Counts in between, since asking for the parent is a system call. The parent may be gone before the first question.
BUSY = "import os, sys\nwhile os.getppid() == int(sys.argv[1]):\n    for _ in range(1_000_000): pass"


def main(words: Sequence[str]) -> int:
    """The command's exit code.

    Args:
        words: How many processes are busy, then the command.
    """
    if len(words) < 2 or not words[0].isdigit():
        print("usage: python -m tools.beside_load COUNT COMMAND...", file=sys.stderr)
        return 2
    count, *command = words
    busy = [subprocess.Popen([sys.executable, "-I", "-c", BUSY, str(os.getpid())]) for _ in range(int(count))]
    try:
        return subprocess.run(command, check=False).returncode
    finally:
        for process in busy:
            process.kill()
            process.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
