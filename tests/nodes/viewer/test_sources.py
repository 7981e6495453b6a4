"""What the viewer is shown, and who can see it and be spoken to by it."""

import http.client
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
import rerun.chunk

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer import server, sources
from semantic_mapper.nodes.viewer.server import WebViewer
from semantic_mapper.nodes.viewer.sources import Live, show_live, show_saved
from semantic_mapper.replay.map_log import replay_log
from semantic_mapper.replay.rerun_log import RerunLog, recording_file, recording_server
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.keys import allow, make_keys
from semantic_mapper.transport.messages import EndOfStream
from semantic_mapper.transport.sockets import Publisher
from tests.nodes.foxglove.robot import update_for
from tests.nodes.mapper.test_query_service import answering
from tests.nodes.support import addresses_listening, error_line, eventually, is_alive, run
from tests.queries.scene import LABELS, whole_map
from tests.small import tiny_config, tiny_frames

WARM_S = 240.0  # a service may compile kernels before it answers


def logged(path: Path) -> Counter[str]:
    """Rows of each entity of a recording."""
    rows: Counter[str] = Counter()
    for chunk in rerun.chunk.RrdReader(path).stream():
        rows[chunk.entity_path] += chunk.num_rows
    return rows


def test_the_page_is_served_here_alone_and_may_speak_to_nobody_else() -> None:
    with WebViewer(0) as viewer:
        page, data = urlsplit(viewer.page_url), urlsplit(viewer.data_url)
        assert parse_qs(page.query)["url"] == [viewer.data_url]
        assert page.port and data.port
        assert addresses_listening(page.port) == addresses_listening(data.port) == {"0100007F"}
        connection = http.client.HTTPConnection(page.hostname or "", page.port, timeout=10)
        connection.request("GET", f"/?{page.query}")
        answer = connection.getresponse()
        shown = answer.read()
        assert answer.status == 200 and b"re_viewer.js" in shown and b'<link rel="icon"' in shown
        assert len(shown) == int(answer.headers["Content-Length"]) and b"fonts.g" not in shown
        rules = dict(rule.strip().split(" ", 1) for rule in answer.headers["Content-Security-Policy"].split(";"))
        assert rules["connect-src"].split() == ["'self'", "data:", "blob:", f"http://127.0.0.1:{data.port}"]
        assert "http" not in rules["default-src"]
        connection.request("GET", "/re_viewer_bg.wasm")
        answer = connection.getresponse()
        assert answer.headers["Content-Type"] == "application/wasm" and answer.read(4) == b"\0asm"
        connection.close()
        [settings] = Path(tempfile.gettempdir()).glob(f"semantic-mapper-{os.getpid()}-view-*/config/rerun/*.json")
        assert json.loads(settings.read_text())["analytics_enabled"] is False
        log = RerunLog(recording_server(viewer.data_url), LABELS)
        log.log_map(whole_map().points())
        log.close()  # all of it has been taken
        with pytest.raises(TransportError, match=f"port {page.port} cannot be had"):
            WebViewer(page.port).__enter__()
        pid = viewer.pid
    assert not is_alive(pid) and not addresses_listening(page.port) and not addresses_listening(data.port)
    assert not settings.exists()


@pytest.mark.slow
def test_what_cannot_be_shown_is_refused_before_a_page_is_promised(tmp_path: Path) -> None:
    for name in ("map.npz", "log.mcap", "text"):
        (tmp_path / name).write_bytes(b"neither of these" * 100)
    for source, reason in (
        (tmp_path / "map.npz", "damaged or not a map"),
        (tmp_path / "log.mcap", "--view` shows it"),
        (tmp_path / "text", "no socket folder of a launch"),
        ("tcp://10.1.2.3:5570", "without keys"),
    ):
        done = run("view", source, "--port", "0")
        assert done.returncode == 1 and reason in error_line(done.stderr)
        assert not done.stdout and len(done.stderr.splitlines()) == 1, "no address, and nothing of Rerun's"


def test_a_viewer_that_does_not_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "rerun"
    locked = 'if sys.argv[1] != "analytics": sys.exit("the door is locked")'
    program.write_text(f"#!{sys.executable} -I\nimport sys\n{locked}\n")
    program.chmod(0o755)
    monkeypatch.setattr(server, "PROGRAM", program)
    with pytest.raises(TransportError, match=r"has not started.* the door is locked"), WebViewer(0):
        pass


def test_a_viewer_that_is_killed_leaves_no_server() -> None:
    program = (
        "import time\nfrom semantic_mapper.nodes.viewer.server import WebViewer\n"
        "with WebViewer(0) as viewer:\n    print(viewer.pid, flush=True)\n    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        server = int(process.stdout.readline())
        assert is_alive(server)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert eventually(lambda: not is_alive(server), 10)


def test_a_log_is_mapped_and_shown_with_all_colourings(
    log: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("REFRESH_S", 0.0), ("PAUSE", 0.0), ("IMAGE_S", 0.0)):
        monkeypatch.setattr(sources, name, value)
    path = tmp_path / "log.rrd"
    watch = partial(sources.WatchedSession, lambda: recording_file(path))
    replay_log(log, tmp_path / "out", weights, tiny_config(), max_frames=3, watch=watch)
    rows = logged(path)
    camera = f"/world/cameras/{tiny_frames()[0].camera_id}/image"
    assert rows[f"{camera}/rgb"] == rows[f"{camera}/semantics"] == rows[f"{camera}/depth"] == 3
    assert rows["/stage_ms/fuse"] == 3 and rows["/legend"] >= 2
    for colouring in ("class", "colour", "confidence"):
        assert rows[f"/world/map/{colouring}"] == rows["/legend"]


@contextmanager
def watching_live(live: Live, path: Path, told: list[str]) -> Iterator[StopRequest]:
    """Somebody who watches, until it is over or asked to stop at the end."""
    stop = StopRequest()
    watcher = threading.Thread(target=show_live, args=(live, lambda: recording_file(path), 0.2, stop, told.append))
    watcher.start()
    try:
        yield stop
        watcher.join(60 if not stop else 10)
    finally:
        stop.signum = stop.signum or signal.SIGTERM
        watcher.join(30)
        assert not watcher.is_alive()


def test_a_running_system_is_shown_until_its_stream_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, shown, show = tiny_frames()[:3], threading.Event(), sources.MapShow.show
    monkeypatch.setattr(sources.MapShow, "show", lambda *state: (show(*state), shown.set()))
    told: list[str] = []
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        live = Live(f"ipc://{folder}/query", (f"ipc://{folder}/camera",))
        with Publisher(live.nodes[0]) as publisher, watching_live(live, tmp_path / "live.rrd", told):
            assert not publisher.subscribers("frame"), "before its mapper is there it is no listener"
            with answering(live.mapper, whole_map()):
                assert eventually(lambda: publisher.subscribers("frame") > 0, WARM_S)
                for frame in frames:
                    publisher.publish(encode_frame(frame))
                    publisher.publish(encode(update_for(frame, LABELS.ids[0])))
                assert shown.wait(60)
                publisher.publish(encode(EndOfStream("camera", "end", len(frames))))
                assert eventually(lambda: "the stream has ended" in told, 60)
                assert eventually(lambda: not publisher.subscribers("frame"), 10), "the camera may go"
    rows = logged(tmp_path / "live.rrd")
    camera = f"/world/cameras/{frames[0].camera_id}/image"
    assert 1 <= rows[f"{camera}/rgb"] <= 3 and 1 <= rows[f"{camera}/semantics"] <= 3, "the newest of what came"
    assert rows["/world/map/class"] == 1, "a map that has not changed is not sent again"


def test_a_map_on_another_machine_is_shown_to_who_has_a_key_and_a_saved_one(tmp_path: Path) -> None:
    whole_map().save(tmp_path / "map.npz")
    show_saved(tmp_path / "map.npz", lambda: recording_file(tmp_path / "map.rrd"))
    rows = logged(tmp_path / "map.rrd")
    assert rows["/world/map/class"] == rows["/legend"] == 1
    robot, desk = make_keys(tmp_path / "robot"), make_keys(tmp_path / "desk")
    allow(robot.folder, "desk", desk.public.decode())
    allow(desk.folder, "robot", robot.public.decode())
    with answering("tcp://127.0.0.1:*", whole_map(), robot) as service:
        live = Live(service.endpoint, (), "robot", desk.folder)
        with watching_live(live, tmp_path / "live.rrd", []) as stop:
            assert eventually(lambda: service.answered >= 4, WARM_S)
            stop.signum = signal.SIGTERM
    assert logged(tmp_path / "live.rrd")["/world/map/class"] == 1
