"""What workers do in tests of the driver; the folder to leave traces in comes as a tag."""

import os
import signal
import time
from pathlib import Path

from semantic_mapper.errors import LogError, StoreError
from semantic_mapper.nodes.fleet.run import Task
from semantic_mapper.nodes.fleet.store import LogInput


def do_as_named(task: Task, log: LogInput) -> bool:
    """The name of the log says what becomes of the task, "once" at its first attempt only; leaves traces of all."""
    name = log.url
    folder = Path(log.tags["traces"])
    attempt = len(list(folder.glob(f"{name}.*")))
    (folder / f"{name}.{attempt}").touch()
    if "once" in name and attempt:
        return True
    if name.startswith("bad"):
        raise LogError(f"{name}: cannot be read")
    if name.startswith("away"):
        raise StoreError(f"{name}: the store is away")
    if name.startswith("dies"):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("sleeps"):
        time.sleep(300)
    return not name.startswith("exists")
