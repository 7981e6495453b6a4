"""One node process as its launcher sees it: started, watched, asked to stop, killed if need be."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque

import msgspec

from nodes.options import NodeJob

TAIL_LINES = 12
FAILURE_EVENT = "node_failed"  # see node.py


class Child:
    """A running node. Its stderr is passed on line by line, marked with its name.

    Args:
        kind: Module in ``nodes`` that it runs.
        job: What it is to do; ``heartbeat_fd`` is filled in here.
    """

    def __init__(self, kind: str, job: NodeJob) -> None:
        self.name = job.name
        self.kind = kind
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.asked_to_stop = False
        self._beats, theirs = os.pipe()
        os.set_blocking(self._beats, False)
        self._last_beat = time.monotonic()
        told = msgspec.json.encode(msgspec.structs.replace(job, heartbeat_fd=theirs)).decode()
        try:
            self._process = subprocess.Popen(
                # -I: a sourced workspace on PYTHONPATH, or a file in the current folder, cannot shadow our modules.
                [sys.executable, "-I", "-m", f"nodes.{kind}", told],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=(theirs,),
                process_group=0,  # Ctrl-C in the terminal reaches the launcher only, which then stops all in order
            )
        finally:
            os.close(theirs)
        self._reader = threading.Thread(target=self._pass_on, name=f"stderr of {self.name}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        return self._process.poll()

    def silent_s(self) -> float:
        """Seconds since its last sign of life."""
        try:
            if os.read(self._beats, 4096):
                self._last_beat = time.monotonic()
        except BlockingIOError:
            pass
        return time.monotonic() - self._last_beat

    def has_failed(self) -> bool:
        """Ended otherwise than well; a SIGTERM of ours may hit a process that is too young to handle it."""
        code = self.exit_code()
        return code not in ((None, 0, -signal.SIGTERM) if self.asked_to_stop else (None, 0))

    def ask_to_stop(self) -> None:
        """SIGTERM, once; no matter if it has ended already."""
        if not self.asked_to_stop:
            self.asked_to_stop = True
            self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL; no matter if it has ended already."""
        self._process.kill()

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends within the time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Kill it if it still runs, and free what belongs to it."""
        if self.exit_code() is None:
            self._process.kill()
        self._process.wait()
        self._reader.join(timeout=2.0)  # a grandchild could keep the pipe open
        os.close(self._beats)

    def describe_end(self) -> str:
        """How it ended, with its last words."""
        code = self._process.returncode
        how = f"exit code {code}" if code is None or code >= 0 else f"killed by {signal.Signals(-code).name}"
        self._reader.join(timeout=2.0)
        lines = [line for line in self.tail if line.strip()]
        # A node that knows why it fails says so in one line; of any other end, all the last lines may tell.
        words = " | ".join([line for line in lines if FAILURE_EVENT in line] or lines)
        return f"node '{self.name}' ({self.kind}) ended: {how}" + (f"; its last words: {words}" if words else "")

    def _pass_on(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        with stream:
            for raw in stream:
                line = raw.decode(errors="replace").rstrip("\n")
                self.tail.append(line)
                try:
                    sys.stderr.write(f"[{self.name}] {line}\n")
                    sys.stderr.flush()
                except (OSError, ValueError):  # nobody reads our stderr any more; the tail is still kept
                    continue
