"""The labelling page over HTTP: who may, what it takes, what it writes."""

import http.client
import json
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import TransportError
from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.labeller.server import LabelServer, LabelSession
from semantic_mapper.replay.label_folder import make_label_folder
from semantic_mapper.replay.log.sequence import open_log
from tests.nodes.support import addresses_listening

HEIGHT, WIDTH = 72, 96
WALL, FLOOR = ROOMS.id_of("wall"), ROOMS.id_of("floor")


class Answer(NamedTuple):
    status: int
    body: bytes
    headers: Mapping[str, str]

    @property
    def says(self) -> str:
        return json.loads(self.body)["error"]


class Page(NamedTuple):
    url: str
    out: Path

    @property
    def token(self) -> str:
        return urlsplit(self.url).path.strip("/")

    def ask(self, path: str, method: str = "GET", body: bytes | None = None, **headers: str) -> Answer:
        """What is behind the token; a path that begins with / stands for itself."""
        place = urlsplit(self.url)
        with closing(http.client.HTTPConnection(str(place.hostname), place.port, timeout=20)) as connection:
            whole = path if path.startswith("/") else place.path + path
            connection.putrequest(method, whole, skip_host="Host" in headers, skip_accept_encoding=True)
            if body is not None:
                headers = {"Content_Length": str(len(body)), **headers}
            for name, value in headers.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders(body)
            came = connection.getresponse()
            return Answer(came.status, came.read(), dict(came.headers))


@pytest.fixture
def page(log: Path, tmp_path: Path) -> Iterator[Page]:
    out = tmp_path / "labels"
    with open_log(log) as opened:
        folder = make_label_folder(out, opened, ROOMS)
        with LabelServer(LabelSession(opened, folder, [4, 1]), 0) as server:
            yield Page(server.url, out)


def strokes() -> np.ndarray[Any, Any]:
    label = np.full((HEIGHT, WIDTH), ROOMS.ignore_id, np.uint8)
    label[10:20, 5:60], label[50:60, 5:60] = WALL, FLOOR
    return label


def test_the_page_and_its_parts_are_there_for_who_has_the_token(page: Page) -> None:
    for path, kind, holds in (
        ("", "text/html", b"page.js"),
        ("page.js", "text/javascript", b"strokes.js"),
        ("strokes.js", "text/javascript", b"class Strokes"),
        ("page.css", "text/css", b"#stage"),
        ("session", "application/json", b"wall"),
    ):
        answer = page.ask(path)
        assert answer.status == 200 and holds in answer.body, path
        assert answer.headers["Content-Type"].startswith(kind)
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["Referrer-Policy"] == "no-referrer"
    assert b"http" not in page.ask("").body + page.ask("page.css").body, "it fetches nothing from elsewhere"


def test_nothing_is_there_without_the_token_nor_on_another_address(page: Page, log: Path, tmp_path: Path) -> None:
    for path in ("/", "/session", "/x/session", f"/{page.token[:-1]}/session"):
        for method, body in (("GET", None), ("PUT", strokes().tobytes())):
            answer = page.ask(path, method, body)
            assert answer.status == 403 and page.token.encode() not in answer.body
    assert not list(page.out.glob("*.png"))
    port = urlsplit(page.url).port or 0
    assert addresses_listening(port) == {"0100007F"}, "on loopback alone"
    with open_log(log) as opened:
        session = LabelSession(opened, make_label_folder(tmp_path / "more", opened, ROOMS), [0])
        with LabelServer(session, 0) as other:
            token = urlsplit(other.url).path.strip("/")
            assert page.token != token and min(len(page.token), len(token)) >= 32
            with pytest.raises(TransportError, match="give another one with --port"):
                LabelServer(session, port)


def test_names_that_lead_here_from_elsewhere_are_refused(page: Page) -> None:
    port = urlsplit(page.url).port
    assert page.ask("session", Host=f"localhost:{port}").status == 200
    assert page.ask("session", Host="127.0.0.1:1234").status == 200, "a tunnel has another port"
    for name in (f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", ""):
        assert page.ask("session", Host=name).status == 403
    assert page.ask("session", Origin="http://evil.example:80").status == 403
    for origin in ("null", "http://[", ""):
        assert page.ask("session", Origin=origin).status == 403, origin


def test_the_session_says_what_to_paint_on_the_images_of_the_log(page: Page, log: Path) -> None:
    session = json.loads(page.ask("session").body)
    assert session["order"] == [4, 1] and session["labelled"] == [] and session["frames"] == 6
    assert session["log"] == "room.mcap" and session["ignore"] == ROOMS.ignore_id
    assert [c["name"] for c in session["classes"]] == list(ROOMS.names)
    assert session["classes"][0] == {"id": WALL, "name": "wall", "color": list(ROOMS.colors[0])}
    answer = page.ask("frames/4/image")
    assert answer.headers["Content-Type"] == "image/jpeg"
    seen = cv2.imdecode(np.frombuffer(answer.body, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    with open_log(log) as opened:
        assert np.abs(seen.astype(int) - opened.frame(4).rgb).mean() < 4


def test_what_is_painted_is_a_label_image_and_comes_back(page: Page, log: Path) -> None:
    nothing = page.ask("frames/1/label").body
    assert nothing == bytes([ROOMS.ignore_id]) * (HEIGHT * WIDTH)
    assert page.ask("frames/1/label", "PUT", strokes().tobytes()).status == 200
    written = cv2.imread(str(page.out / "000001.png"), cv2.IMREAD_UNCHANGED)
    assert written.dtype == np.uint8 and (written == strokes()).all()
    assert page.ask("frames/1/label").body == strokes().tobytes()
    assert json.loads(page.ask("session").body)["labelled"] == [1]
    labels = json.loads((page.out / "labels.json").read_text())
    assert labels["log"]["name"] == "room.mcap" and labels["log"]["frames"] == 6
    assert labels["classes"][str(WALL)] == "wall" and labels["ignore"] == ROOMS.ignore_id
    page.ask("frames/1/label", "PUT", nothing)
    assert not (page.out / "000001.png").exists(), "all of it is erased"


def test_bad_labels_are_refused_and_nothing_is_written(page: Page) -> None:
    (page.out / "000004.png").write_bytes(b"no image")
    before, good = sorted(p.name for p in page.out.parent.rglob("*")), strokes().tobytes()
    for frame, body, status, says in (
        ("1", strokes()[:-1].tobytes(), 400, "has 6912 pixels"),
        ("1", bytes([200]) * (HEIGHT * WIDTH), 400, "class ids [200] are not in label set"),
        ("6", good, 400, "has no frame 6; it has 6"),
        ("-1", good, 404, "no such page"),
        ("..%2f1", good, 404, "no such page"),
    ):
        answer = page.ask(f"frames/{frame}/label", "PUT", body)
        assert (answer.status, says in answer.says) == (status, True), answer.body
    for length in ("", "-1", "999999999999"):  # refused before anything is read
        assert page.ask("frames/1/label", "PUT", b"x", Content_Length=length).status in (400, 411)
    for path in ("../labels.json", "..%2flabels.json", "x"):
        assert page.ask(path).status == 404, "only files of the page"
    damaged = page.ask("frames/4/label")
    assert damaged.status == 400 and "000004.png" in damaged.says
    assert (page.out / "000004.png").read_bytes() == b"no image"
    assert sorted(p.name for p in page.out.parent.rglob("*")) == before


def test_what_was_changed_in_another_tab_is_not_overwritten(page: Page) -> None:
    first, second = page.ask("frames/1/label"), page.ask("frames/1/label")
    one, other = strokes(), strokes()
    one[30:40] = WALL
    saved = page.ask("frames/1/label", "PUT", one.tobytes(), If_Match=first.headers["ETag"])
    assert saved.status == 200
    late = page.ask("frames/1/label", "PUT", other.tobytes(), If_Match=second.headers["ETag"])
    assert late.status == 412 and "frame 1 was changed elsewhere" in late.says
    assert page.ask("frames/1/label").body == one.tobytes()
    again = page.ask("frames/1/label", "PUT", other.tobytes(), If_Match=saved.headers["ETag"])
    assert again.status == 200 and page.ask("frames/1/label").headers["ETag"] == again.headers["ETag"]


def test_what_strokes_grow_to_keeps_them_and_adds_to_them(page: Page) -> None:
    assert set(page.ask("frames/4/grown").body) == {ROOMS.ignore_id}, "nothing is painted"
    painted = strokes()
    page.ask("frames/4/label", "PUT", painted.tobytes())
    answer = page.ask("frames/4/grown")
    grown = np.frombuffer(answer.body, np.uint8).reshape(HEIGHT, WIDTH)
    assert answer.status == 200 and (grown[painted != ROOMS.ignore_id] == painted[painted != ROOMS.ignore_id]).all()
    assert (grown != ROOMS.ignore_id).sum() > 1.2 * (painted != ROOMS.ignore_id).sum()
    assert set(np.unique(grown)) <= {ROOMS.ignore_id, WALL, FLOOR}
    assert page.ask("frames/4/label").body == painted.tobytes(), "only strokes are saved"
