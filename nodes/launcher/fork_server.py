"""A process that has imported PyTorch, Open3D and ZeroMQ, and forks nodes that need not import them again.

Where there is a CUDA driver, nodes import Open3D themselves.

A forked node becomes a child of the launcher (a "child subreaper"), so that the launcher can wait for it and the node
outlives the fork server. The server starts no threads; those of OpenBLAS end before each fork.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import importlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping

import msgspec
import psutil
import structlog

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.nodes.launcher.liveness import end_with_launcher
from semantic_mapper.nodes.node import read_job
from semantic_mapper.nodes.process import prepare_process

START_S = 300.0  # for the imports
ANSWER_S = 30.0  # for a node, on a machine that has too much to do
_PRELOAD = ("zmq", "torch", "cv2", "scipy.spatial")
_PR_SET_CHILD_SUBREAPER = 36
_READY = b"ready"

_log = structlog.get_logger(__name__)


class ForkServer:
    """The launcher's end; starts the server with the first node, and again where it has died."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = environment
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    def fork(self, module: str, job: int, heartbeat: int, output: int) -> psutil.Process:
        """Start a node.

        Args:
            module: With ``main(job)``.
            job: Open file with a ``NodeJob``.
            heartbeat: Pipe for its heartbeats.
            output: Pipe for its stdout and stderr.

        Raises:
            OSError: the server cannot be started, or does not answer; the next call starts another one.
        """
        try:
            channel = self._connect()
            socket.send_fds(channel, [module.encode()], [job, heartbeat, output])
            answer = _answer(channel, ANSWER_S)
        except OSError:
            self.close()
            raise
        return psutil.Process(int(answer))

    def close(self) -> None:
        """End the server; nodes that it has forked go on. Harmless when repeated."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _connect(self) -> socket.socket:
        if self._process is not None and self._process.poll() is not None:
            _log.warning("fork_server_died", code=self._process.returncode)
            self.close()
        if self._socket is not None:
            return self._socket
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket = ours
        with theirs:
            code = f"from {__name__} import serve; serve({theirs.fileno()})"
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-c", code],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env=self._environment,
                process_group=0,
            )
        _log.info("fork_server_started", pid=self._process.pid)
        _answer(ours, START_S)
        return ours


def _answer(channel: socket.socket, limit_s: float) -> bytes:
    """What the server says next."""
    channel.settimeout(limit_s)
    try:
        answer = channel.recv(64)
    except TimeoutError as error:
        raise TimeoutError(errno.ETIMEDOUT, f"the fork server said nothing for {limit_s:g} s") from error
    if not answer:
        raise OSError(errno.ECONNRESET, "the fork server has ended")
    return answer


def serve(fd: int) -> None:
    """Import what nodes need, then fork one for each message, until the launcher closes the socket or dies."""
    end_with_launcher()
    prepare_process()
    _preload()
    channel = socket.socket(fileno=fd)
    channel.send(_READY)
    while True:
        message, fds, _, _ = socket.recv_fds(channel, 1024, 3)
        if not message:
            return
        middle = os.fork()
        if middle == 0:
            _fork_again(channel)
            _run(message.decode(), *fds)
        if os.waitpid(middle, 0)[1]:
            raise OSError(errno.EAGAIN, "no process is to be had")
        for file in fds:
            os.close(file)


def _preload() -> None:
    """What cannot be imported is reported by the node that needs it."""
    try:
        for name in _PRELOAD:
            importlib.import_module(name)
        if not _has_cuda_driver():
            load_open3d()
    except (ImportError, OSError, MemoryError, SemanticMapperError):
        pass
    gc.collect()
    gc.freeze()  # what is never collected stays shared with the nodes


def _has_cuda_driver() -> bool:
    """Whether Open3D would initialise CUDA when imported, which a forked process could not use any more."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def _fork_again(channel: socket.socket) -> None:
    """Return in a grandchild, once the launcher has adopted it and knows its number; the process between ends."""
    middle = os.getpid()
    if os.fork():
        os._exit(0)
    while os.getppid() == middle:
        time.sleep(0.0005)
    os.setpgid(0, 0)  # Ctrl-C in the terminal reaches the launcher only
    channel.send(str(os.getpid()).encode())
    channel.close()


def _run(module: str, job: int, heartbeat: int, output: int) -> None:
    """Be the node; does not return."""
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    importlib.import_module(module).main(msgspec.structs.replace(read_job(f"fd:{job}"), heartbeat_fd=heartbeat))
