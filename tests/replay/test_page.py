"""Reports: one well-formed page, whose pictures are inside and which asks nobody for anything."""

import base64
import hashlib
import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.artifacts import finish_session
from semantic_mapper.replay.evaluate.report import write_eval_report
from semantic_mapper.replay.page import Section, write_page
from semantic_mapper.replay.session import MapSession
from tests.nodes.support import write_weights
from tests.small import tiny_config, tiny_frames


def read_page(path: Path) -> ElementTree.Element:
    """The page, checked to be one that stands alone."""
    text = path.read_text(encoding="utf-8")
    doctype, _, rest = text.partition("\n")
    assert doctype == "<!DOCTYPE html>"
    page = ElementTree.fromstring(rest)
    (policy,) = [m.get("content") or "" for m in page.iter("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data:; ")
    scripts = [s.text or "" for s in page.iter("script") if s.get("type") is None]
    for script in scripts:  # as a browser that reads HTML does, which knows no CDATA
        whole = text.partition("<script>")[2].partition("</script>")[0]
        digest = base64.b64encode(hashlib.sha256(whole.encode()).digest()).decode()
        assert f"script-src 'sha256-{digest}'" in policy and script in whole.replace("<![CDATA[", "").replace("]]>", "")
    for element in page.iter():
        for name in ("src", "href", "srcset", "action", "data"):
            assert element.get(name, "data:").startswith("data:"), f"{element.tag} asks for {element.get(name)}"
    assert "url(" not in text.partition("</style>")[0] and "@import" not in text
    return page


def pictures(page: ElementTree.Element) -> list[np.ndarray]:
    found = []
    for image in page.iter("img"):
        kind, _, data = (image.get("src") or "").partition(";base64,")
        assert kind in ("data:image/png", "data:image/jpeg") and image.get("alt")
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(data, validate=True), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None and picture.std() > 5
        found.append(picture)
    return found


def cells(page: ElementTree.Element) -> dict[str, list[str]]:
    """Rows of all tables, by their first cell."""
    rows = [["".join(c.itertext()) for c in row] for row in page.iter("tr")]
    return {row[0]: row[1:] for row in rows}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a session of three frames and a refused one leaves."""
    out = tmp_path_factory.mktemp("run")
    mapper = Mapper.load(write_weights(out / "w.safetensors"), tiny_config())
    session = MapSession(mapper, stream_labels=ROOMS, source="<room> & hall")
    for frame in tiny_frames()[:3]:
        session.process(frame)
    session.refuse(3, 77, "a pose that is no <pose>")
    session.note_damage("bytes 5 to 9")
    finish_session(session, out, "SIGINT")
    return out


def test_a_replay_leaves_a_report_with_its_figures_and_pictures(run: Path) -> None:
    page, summary = read_page(run / "report.html"), json.loads((run / "summary.json").read_text())
    assert page.findtext("body/h1") == "Map of <room> & hall"
    shown = cells(page)
    assert shown["frames: refused"] == ["1"] and shown["frames: scored"] == ["3"]
    assert shown["mIoU"] == [f"{summary['metrics']['miou'] * 100:.1f} %"]
    assert shown["3"] == ["77", "a pose that is no <pose>"]
    assert shown["stage p50, p95: fuse"] == ["{p50:.2f}, {p95:.2f} ms".format(**summary["stages_ms"]["fuse"])]
    assert shown["torch"] == [summary["versions"]["torch"]]
    found = pictures(page)
    assert len(found) == 1 + 3, "overview and a strip a frame"
    overview = cv2.imread(str(run / "overview.png"))
    assert overview is not None and found[0].shape == overview.shape
    assert np.abs(found[0].astype(int) - overview).mean() < 6, "the overview itself"
    text = "".join(page.itertext())
    assert "stopped by SIGINT" in text and "bytes 5 to 9" in text
    assert json.loads(page.findtext(".//details/pre") or "") == summary["config"]


def test_the_map_is_on_the_page_in_3d_with_a_legend(run: Path) -> None:
    page, summary = read_page(run / "report.html"), json.loads((run / "summary.json").read_text())
    data = json.loads(page.findtext(".//script[@id='points']") or "")
    points = VoxelMap.load(run / "map.npz").points()
    assert data["count"] == len(points.xyz) == summary["map"]["surface_points"]
    xyz, rgb = (np.frombuffer(base64.b64decode(data[name]), kind) for name, kind in (("xyz", "<u2"), ("rgb", "u1")))
    placed = np.array(data["low"]) + np.array(data["extent"]) * xyz.reshape(-1, 3) / 65535
    spread = [np.sort(np.linalg.norm(p - p.mean(axis=0), axis=1)) for p in (placed, points.xyz.astype(float))]
    np.testing.assert_allclose(*spread, atol=2e-3), "turned upright, no more"
    np.testing.assert_array_equal(np.sort(rgb), np.sort(points.rgb.ravel()))
    boxes = [int(box.get("value") or 0) for box in page.iter("input") if box.get("type") == "checkbox"]
    label = np.frombuffer(base64.b64decode(data["label"]), np.uint8)
    assert sorted(boxes) == np.unique(label).tolist() == np.unique(points.label).tolist()


def test_replays_and_logs_are_compared_on_a_page(run: Path, tmp_path: Path) -> None:
    summary = json.loads((run / "summary.json").read_text())
    scores = {"methods": {}, "scored": 2, "excluded": 1, "pseudo_labelled": 0, "notes": ["S-Ray is below U-Net"]}
    for name, miou in (("S-Ray", 0.5), ("U-Net", 0.25)):
        figures = dict.fromkeys(("miou", "total_accuracy", "average_accuracy", "coverage"), miou)
        scores["methods"][name] = {**figures, "per_class": {"wall": miou, "floor": None}}
    found = {"replays": {"a": summary, "b": summary}, "logs": {"x/kitchen.mcap": scores}}
    write_eval_report(tmp_path / "eval.html", found, [run, tmp_path])
    page = read_page(tmp_path / "eval.html")
    assert page.findtext("body/h1") == "Evaluation of a, b, kitchen.mcap"
    shown = cells(page)
    assert shown["coverage"] == ["50.0 %", "25.0 %"] and shown["IoU floor"] == ["-", "-"]
    assert "S-Ray is below U-Net" in "".join(page.itertext())
    assert len(shown["frames: fused"]) == 2
    assert len(pictures(page)) == 1, "the overview that is there"


def test_a_page_that_cannot_be_written_says_so_and_leaves_the_old_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"page\.html: cannot be written"):
        write_page(tmp_path / "file" / "page.html", "x", [Section()])
