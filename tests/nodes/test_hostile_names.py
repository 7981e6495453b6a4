"""Names of classes, cameras and files are text for every verb, whatever they hold; no secret of an address is shown."""

import io
import json
import os
from pathlib import Path

import pytest
import structlog
from rich.table import Table

from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.files import write_json
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.launcher.processes import NodeProcess
from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.process import prepare_process
from semantic_mapper.plain_text import visible
from semantic_mapper.replay.log.format import LogAttachment, LogWriter
from semantic_mapper.replay.page import Section, table_of, write_page
from semantic_mapper.transport.messages import StreamInfo
from tests.nodes.support import error_line, refused, run, run_ok
from tests.small import INTRINSICS, tiny_field, tiny_frames

NAMES = ("[/b]", "[bold]x", "a\x1b]0;title\x07", "over\rwritten", "turned\u202eback", "two\nlines", ":smile:", "<i>&")
SHOWN = ("[/b]", "[bold]x", r"a\x1b]0;title\x07", r"over\rwritten", r"turned\u202eback", r"two\nlines", *NAMES[6:])
HOSTILE = LabelSet("set[/b]\x1b[2J", ROOMS.ids, NAMES + ROOMS.names[len(NAMES) :], ROOMS.colors)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log and weights whose classes, source, metadata and attachment have hostile names."""
    folder = tmp_path_factory.mktemp("hostile")
    info = StreamInfo(
        source="log [/b]\x1b[2J",
        cameras={"rooms": INTRINSICS},
        label_set=HOSTILE,
        frame_count=4,
        metadata={"[/b]\x1b": "[/red]\u202e"},
    )
    files = [LogAttachment(name, "text/plain", b"x") for name in ("[/b].txt", "\x1b[31m.txt")]
    with LogWriter(folder / "log.mcap", info, attachments=files) as log:
        for frame in tiny_frames(4):
            log.write_frame(frame)
    recipe = {"kind": "test", "width": 96, "train_stamps_ns": []}
    save_checkpoint(Checkpoint(tiny_field(HOSTILE), (), recipe), folder / "tiny.safetensors")
    return folder


@pytest.fixture(scope="module")
def results(hostile: Path, config: Path) -> Path:
    out = hostile / "run"
    options = ("--out", out, "--weights", hostile / "tiny.safetensors", "--config", config)
    assert r"log [/b]\x1b[2J" in plain_text_of("map", hostile / "log.mcap", *options)
    said = plain_text_of("eval", out)
    assert "IoU [/b]" in said and "IoU [bold]x" in said
    return out


def plain_text_of(*arguments: str | Path) -> str:
    """All that the command says, without line breaks: nothing of it may move a terminal's cursor or fail."""
    done = run(*arguments)
    said = " ".join((done.stdout + done.stderr).split())
    assert visible(said) == said and "Traceback" not in said, said
    return said


def test_info_shows_all_names_as_they_are(hostile: Path) -> None:
    done = run("info", hostile / "[/b]\x1b]0;x\x07\nerror: forged\u202e.mcap")
    line = error_line(done.stderr)
    assert r"[/b]\x1b]0;x\x07" in line and r"\u202e" in line and "\x1b" not in done.stderr
    said = plain_text_of("info", hostile / "log.mcap")
    for name in (*SHOWN, "file [/b].txt", r"file \x1b[31m.txt", r"log [/b]\x1b[2J", r"[/red]\u202e"):
        assert "".join(name.split()) in "".join(said.split()).replace("│", ""), name


@pytest.mark.slow
def test_names_in_results_maps_and_scores_are_text(hostile: Path, results: Path, config: Path, tmp_path: Path) -> None:
    log, weights = hostile / "log.mcap", hostile / "tiny.safetensors"
    for arguments in (
        ("info", results / "map.npz"),
        ("eval", results),
        ("eval", log, "--weights", weights, "--config", config, "--out", tmp_path / "eval.json"),
        ("eval", results, "--against", results),
        ("query", results, "instances"),
        ("query", results, "class", "[/b]"),
        ("export", results, "--out", tmp_path / "map.ply"),
        ("export", log, "--out", tmp_path / "folder", "--format", "folder"),
        ("import", log, tmp_path / "recovered.mcap"),
        ("label", log, "--to", "ipc:///[/b]\x1b"),
        ("finetune", log, "--out", tmp_path / "[/b]" / "w.safetensors", "--weights", tmp_path / "[/b]\x1b"),
        ("merge", results, results, "--out", tmp_path / "merged[/b].npz"),
        ("up", tmp_path / "[/b]\x1b.toml"),
        ("view", tmp_path / "[/b]\x1b.mcap"),
        ("view", "--status", "ipc:///[/b]\x1b"),
    ):
        plain_text_of(*arguments)


def test_report_pages_hold_names_as_text(results: Path) -> None:
    page = (results / "report.html").read_text(encoding="utf-8")
    assert visible(page, keep="\n") == page
    assert r"log [/b]\x1b[2J" in page and "IoU [/b]" in page
    hostile = "</script><b>\u202e"
    view = {"classes": [{"id": 1, "name": hostile, "color": "red", "share": "1 %"}], "data": {"name": hostile}}
    table = table_of(("<i>",), [("\x1b[2J",)])
    section = Section(hostile, [hostile], view, tables=[table], folded={hostile: hostile})
    write_page(results / "made.html", hostile, [section])
    text = (results / "made.html").read_text(encoding="utf-8")
    assert visible(text, keep="\n") == text and text.count("</script>") == 2
    assert "<b>" not in text and "<i>" not in text and r"\x1b[2J" in text and r"\u202e" in text


def test_events_and_lines_of_nodes_are_plain(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    options = {"log": str(tmp_path / "gone[/b]\x1b]0;x\x07.mcap"), "mode": "fast"}
    child = NodeProcess("camera", NodeJob(name="camera", options=options))
    try:
        assert child.wait(60)
        for said in (child.describe_end(), capfd.readouterr().err):
            assert "gone[/b]" in said and "\x1b" not in said
    finally:
        child.close()


def test_files_and_numbers_that_cannot_be_used_are_refused_by_name(tmp_path: Path, log: Path) -> None:
    (folder := tmp_path / "dir.toml").mkdir()
    os.mkfifo(pipe := tmp_path / "pipe")
    (big := tmp_path / "big.json").write_text('{"boxes": [{"id": ' + "9" * 5000 + "}]}", encoding="utf-8")
    for words, said in (
        (("up", folder), f"{folder}: is a folder, and no launch file"),
        (("info", "/proc/self/mem"), "/proc/self/mem: cannot be read: Input/output error"),
        (("map", pipe, "--out", tmp_path / "o"), f"{pipe}: cannot be read: it is no regular file"),
        (("import", pipe, tmp_path / "o.mcap"), f"{pipe}: is neither a file nor a folder"),
        (("query", "://", "info"), "://: no endpoint; endpoints read"),
        (("finetune", log, "--kind", "panoptic", "--boxes", big, "--out", tmp_path / "s"), "value has 5000 digits"),
    ):
        shown = refused(*words, code=2 if words[0] == "up" else 1)
        assert said in shown and "sys.set_int" not in shown
    launch = tmp_path / "a.toml"
    for option in ("rate = 1e-300", f"rate = {'9' * 5000}", f"max_frames = {'9' * 5000}"):
        launch.write_text(f'[[node]]\nname = "eye"\nkind = "camera"\n[node.options]\nlog = "{log}"\n{option}\n')
        assert "a.toml" in refused("up", launch, code=2)


RESULTS = ("overview.png", "map.npz", "map.ply", "report.html", "summary.json", "eval.json", "eval.html")


def test_no_result_goes_through_a_link(tmp_path: Path, log: Path, weights: Path, config: Path, replayed: Path) -> None:
    target, out = tmp_path / "precious", tmp_path / "out"
    target.write_bytes(b"precious")
    out.mkdir()
    for name in RESULTS:
        for link in (name, name + ".part", "part." + name):
            (out / link).symlink_to(target)
    (out / ".writable").symlink_to(tmp_path / "made")
    run_ok("map", log, "--out", out, "--weights", weights, "--config", config)
    run_ok("eval", out)
    run("eval", replayed, "--against", out)
    assert target.read_bytes() == b"precious" and not (tmp_path / "made").exists()
    assert all((out / name).is_file() and not (out / name).is_symlink() for name in RESULTS)


SECRET = "wJalrXUtnFEMIbPxRfiCYEXAMPLEKEY"
FORMS = (
    f"filecache::s3://KEY:{SECRET}@bucket/x",
    f"s3:/KEY:{SECRET}@bucket/x",
    f"s3:KEY:{SECRET}@bucket",
    f"no/such.mcap;token={SECRET}",
    f"KEY:{SECRET}@bucket/x.mcap",
)


@pytest.mark.parametrize(
    "words",
    [
        "query {} info",
        "query {} info --json",
        "fleet table {}",
        "fleet compare {} {}",
        "fleet run map {} --out store",
        "merge {} a.npz --out store.npz",
        "map {} --out out",
        "import {} a.mcap",
        "info {}",
        "view {}",
        "eval {}",
        "up {}",
        "up replay --set camera.log={} --set camera.mode={}",
        "record a.mcap --launch {}",
    ],
)
def test_no_verb_shows_the_secret_of_an_address(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for url in FORMS if words.startswith(("query", "fleet table")) else FORMS[1:3]:
        done = run(*words.replace("{}", url).split())
        assert done.returncode in (1, 2) and done.stdout + done.stderr
        assert SECRET not in done.stdout + done.stderr


def test_tables_json_reports_and_logs_are_without_secrets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url, stream = f"s3://KEY:{SECRET}@bucket/x", io.StringIO()
    output = Output(stream)
    table = Table(url, title=url)
    table.add_row(url)
    output.print(url, table)
    output.quiet = True
    output.json({"map": url, "logs": [url]})
    write_json(tmp_path / "summary.json", {"source": url})
    write_page(tmp_path / "page.html", url, [Section(url, [url], tables=[table_of((url,), [(url,)])])])
    prepare_process()
    structlog.get_logger("test").error("failed", error=url, places=[url], path=Path(url))
    structlog.reset_defaults()
    written = stream.getvalue() + "".join(path.read_text() for path in tmp_path.iterdir()) + capsys.readouterr().err
    assert written.count("s3://bucket/x") >= 10
    assert "KEY" not in written
    assert json.loads((tmp_path / "summary.json").read_text()) == {"source": "s3://bucket/x"}
    stream = io.StringIO()
    Output(stream).address("watch at", "http://127.0.0.1:9090/?url=x&token=mine")
    assert stream.getvalue() == "watch at http://127.0.0.1:9090/?url=x&token=mine\n", "a page of this machine"
