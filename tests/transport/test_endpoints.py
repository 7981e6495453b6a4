import os
import socket
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.sockets import Publisher, QueryServer


def test_default_endpoints_are_the_same_for_all_processes_and_differ_by_name(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    one, other = default_endpoint("camera"), default_endpoint("camera", "test")
    assert one == default_endpoint("camera") == f"ipc://{tmp_path}/semantic-mapper/default/camera"
    assert other != one
    assert (tmp_path / "semantic-mapper").stat().st_mode & 0o077 == 0
    for name in ("", "../x", "a/b", ".hidden", "a b"):
        with pytest.raises(TransportError):
            default_endpoint(name)


@pytest.mark.parametrize("serve", [Publisher, QueryServer])
def test_a_file_that_is_no_socket_is_never_replaced_by_one(tmp_path: Path, serve: Any) -> None:
    path = tmp_path / "precious"
    for make in (lambda: path.write_bytes(b"precious"), lambda: path.symlink_to(tmp_path / "gone"), path.mkdir):
        make()
        with pytest.raises(TransportError, match="a file is there that is no socket"):
            serve(f"ipc://{path}")
        assert os.path.lexists(path) and not path.is_socket()
        path.rmdir() if path.is_dir() else path.unlink()


@pytest.mark.parametrize("serve", [Publisher, QueryServer])
def test_a_socket_is_its_users_alone_and_one_that_was_left_is_taken_over(tmp_path: Path, serve: Any) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))  # stays when it is closed, as a killed process leaves it
    before = os.umask(0)
    try:
        with closing(serve(f"ipc://{path}")):
            assert path.is_socket() and path.stat().st_mode & 0o777 == 0o600
            assert os.umask(0) == 0
    finally:
        os.umask(before)
