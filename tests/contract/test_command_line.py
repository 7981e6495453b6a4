"""The command line: every verb, option and default of then, and exit codes. Help texts are free."""

import enum
import json
import shutil
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest

from tests.contract import entry_points as api
from tests.contract.golden import LOG, MAP, MAP_COARSE, STORED, WEIGHTS, form, lacking, read, undocumented

# {..} are places of golden files and of a folder of its own for each recording or test, in which the commands run in
# this order: later ones use what earlier ones have made.
COMMANDS: dict[str, str] = {
    "version": "--version",
    "help": "--help",
    "nothing at all": "",
    "info of a log as JSON": "info {log} --json",
    "info of a map as JSON": "info {map} --json",
    "info of nothing": "info {tmp}/none.mcap",
    "info of a damaged log": "info {damaged}",
    "info without a file": "info",
    "recover": "import {cut} {tmp}/clean.mcap",
    "recover what is no log": "import {map} {tmp}/no.mcap",
    "export a log as folder": "export {log} --out {tmp}/sequence --format folder --max-frames 2",
    "import the folder": "import {tmp}/sequence {tmp}/back.mcap",
    "import again": "import {tmp}/sequence {tmp}/back.mcap",
    "import nothing": "import {tmp}/none {tmp}/none.mcap",
    "import with an impossible turn": "import {tmp}/sequence {tmp}/turned.mcap --rotate 45",
    "query info": "query {map} info",
    "query at": "query {map} at 0.5 -0.5 0.25 --json",
    "query nearest": "query {stored} nearest wall 0 0 1 --json",
    "query instances": "query {map} instances --up 0,0,1 --json",
    "query graph": "query {map} graph --up z --json",
    "query of an unknown class": "query {map} nearest unicorn 0 0 1",
    "query with too few numbers": "query {map} at 1 2",
    "query of an unknown kind": "query {map} why",
    "query of a mapper that is not there": "query ipc://{tmp}/none info",
    "export points": "export {map} --out {tmp}/map.ply",
    "export over itself": "export {stored} --out {map} --format ply",
    "export a log as mesh": "export {log} --out {tmp}/log.glb",
    "export to an unknown format": "export {map} --out {tmp}/map.stl",
    "export without a file": "export {map}",
    "merge": "merge {map} {coarse} --poses {poses} --out {tmp}/both.npz --json",
    "merge a map with itself": "merge {map} {stored} --out {tmp}/no.npz",
    "merge maps of other voxels": "merge {map} {tmp}/none.npz --out {tmp}/no.npz",
    "eval against an equal run": "eval {stored} --against {map} --json",
    "eval against another run": "eval {map} --against {coarse}",
    "eval with tolerances and nothing to compare": "eval {stored} --labels 0.1",
    "eval of a log against a map": "eval {log} --against {map}",
    "up with an unknown setting": "up replay --set camera.log={log} --set colour=red",
    "up without a log": "up replay",
    "up of what is no launch file": "up {tmp}/none.toml",
    "keys make": "keys make --keys {tmp}/keys",
    "keys make again": "keys make --keys {tmp}/keys",
    "keys allow": "keys allow robot rq:rM>}}U?@Lns47E1%kR.o@n%FcmmsL/@{{H8]yf7 --keys {tmp}/keys",
    "keys allow what is no key": "keys allow robot hello --keys {tmp}/keys",
    "keys show": "keys show --keys {tmp}/keys --json",
    "keys forget": "keys forget robot --keys {tmp}/keys",
    "keys forget nobody": "keys forget robot --keys {tmp}/keys",
    "keys show without any": "keys show --keys {tmp}/none",
    "finetune without a file": "finetune {log} --keyframes 2",
    "map": "map {log} --out {tmp}/made --weights {weights} --voxel-size 0.05 --json",
    "eval": "eval {log} --out {tmp}/scores.json --weights {weights} --voxel-size 0.1 --json",
    "refine": "refine {tmp}/made --out {tmp}/refined.npz --json",
    "query info as JSON": "query {map} info --json",
    "map nothing": "map {tmp}/none.mcap --out {tmp}/run",
    "map with missing weights": "map {log} --out {tmp}/run --weights {tmp}/none.safetensors",
    "map with voxels of fifty metres": "map {log} --out {tmp}/run --voxel-size 50",
    "map with an unknown quality": "map {log} --out {tmp}/run --quality best",
    "map with an unknown setting": "map {log} --out {tmp}/run --config {wrong}",
    "map with an unknown setting on the line": "map {log} --out {tmp}/run --set colour=red",
    "finetune without keyframes": "finetune {log} --out {tmp}/a.safetensors",
    "finetune with one keyframe": "finetune {log} --out {tmp}/a.safetensors --keyframes 1",
    "autolabel": "autolabel {log} --weights {weights} --out {tmp}/labelled.mcap --overwrite-labels --json",
    "autolabel without weights": "autolabel {log} --out {tmp}/no.mcap",
    "autolabel into the log itself": "autolabel {log} --weights {weights} --out {log}",
    "autolabel into a log that is there": "autolabel {log} --weights {weights} --out {tmp}/labelled.mcap",
    "eval of pseudo labels": "eval {tmp}/labelled.mcap --weights {weights} --out {tmp}/eval.json",
    "weights of nobody": "info ipc://{tmp}/none",
    "label without a finetuner": "label {log} --to",
    "label suggests": "label {log} --suggest 2 --json",
    "label sends without weights": "label {log} --weights {weights}",
    "finetune with labels of nothing": "finetune {log} --labels {tmp}/none --out {tmp}/a.safetensors",
}


def observe(folder: Path) -> dict[str, Any]:
    """Options by verb; exit codes, and the form of what is written as JSON."""
    codes, forms = run_all(folder, list(COMMANDS))
    return {"verbs": verbs(), "codes": codes, "json": forms}


def verbs() -> dict[str, Any]:
    """Each verb and sub-verb with its arguments and options."""
    found: dict[str, Any] = {}
    _walk(api.command_tree(), "", found)
    return found


def _walk(command: Any, path: str, found: dict[str, Any]) -> None:
    parameters = [_describe(p) for p in command.params]
    found[path or "semantic-mapper"] = {
        "options": {name: entry for names, entry in parameters for name in names if entry["kind"] == "option"},
        "arguments": [entry for _, entry in parameters if entry["kind"] == "argument"],
    }
    for name in command.list_commands(None) if hasattr(command, "list_commands") else ():
        _walk(command.get_command(None, name), f"{path} {name}".strip(), found)


def _describe(parameter: Any) -> tuple[list[str], dict[str, Any]]:
    """Names of a parameter, and what else scripts rely on."""
    default = parameter.default
    if isinstance(default, enum.Enum):
        default = default.value
    elif isinstance(default, Path):
        default = default.as_posix()
    elif callable(default):  # a folder of the user, say
        default = "computed"
    kind, choices = _type_of(parameter.type_descriptor.annotation)
    entry = {
        "kind": parameter.param_type_name,
        "type": kind,
        "choices": choices,
        "nargs": parameter.nargs,
        "required": parameter.required,
        "many": getattr(parameter, "multiple", False),
        "flag": getattr(parameter, "is_flag", False),
        "default": list(default) if isinstance(default, tuple) else default,
        "least": getattr(parameter, "min", None),
        "most": getattr(parameter, "max", None),
    }
    return [*parameter.opts, *parameter.secondary_opts], entry


def _type_of(annotation: Any) -> tuple[str, list[str]]:
    """What a text must be, and the only ones that there are."""
    if get_origin(annotation) is Literal:
        return "choice", list(map(str, get_args(annotation)))
    if get_origin(annotation) in (list, tuple):
        return _type_of(get_args(annotation)[0])
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        return "choice", [str(item.value) for item in annotation]
    return {"str": "text", "Path": "text"}.get(annotation.__name__, annotation.__name__), []


def run_all(folder: Path, names: list[str]) -> tuple[dict[str, int], dict[str, Any]]:
    """Exit code of each command of these names, and the form of the JSON that it gives."""
    codes: dict[str, int] = {}
    forms: dict[str, Any] = {}
    places = make_places(folder)
    for name in names:
        words = [word.replace("|", " ").format_map(places) for word in COMMANDS[name].split()]
        ran = api.run_here(*words)
        codes[name] = ran.code
        assert "Traceback" not in ran.stderr, ran.stderr
        if "--json" in words:
            forms[name] = form(json.loads(ran.stdout.replace(f"{LOG.parent}/", "")))
        elif ran.code and words[:1] not in ([], ["info"]) and "--against" not in words:
            assert not ran.stdout, f"{name}: failed, and wrote results: {ran.stdout}"
    return codes, forms


def make_places(folder: Path) -> dict[str, str]:
    """What the names in braces stand for."""
    data = bytearray(LOG.read_bytes())
    (folder / "cut.mcap").write_bytes(data[:-20_000])
    data[len(data) // 2] ^= 0xFF
    (folder / "damaged.mcap").write_bytes(data)
    (folder / "wrong.toml").write_text("[voxel_map]\nvoxel_sise_m = 0.1\n")
    (folder / "poses.json").write_text('{"stored": [0, 0, 0, 0], "coarse": [1.2, 0, 0, 90]}')
    stored = folder / "stored"  # commands that would write there by mistake must not reach golden files
    shutil.copytree(STORED, stored)
    shutil.copyfile(MAP_COARSE, folder / "coarse.npz")
    made = {"cut": "cut.mcap", "damaged": "damaged.mcap", "wrong": "wrong.toml", "coarse": "coarse.npz"} | {
        "poses": "poses.json"
    }
    given = {"log": LOG, "map": stored / MAP.name, "stored": stored, "weights": WEIGHTS, "tmp": folder}
    return {name: str(path) for name, path in ({n: folder / f for n, f in made.items()} | given).items()}


_GOLDEN: dict[str, Any] = read("command_line")


@pytest.mark.parametrize("verb", _GOLDEN["verbs"])
def test_a_verb_takes_what_it_took(verb: str) -> None:
    assert verbs()[verb] == _GOLDEN["verbs"][verb]


_MIDDLE = list(COMMANDS).index("finetune without a file")  # no command behind it needs a file of one before it


@pytest.mark.parametrize("names", [list(COMMANDS)[:_MIDDLE], list(COMMANDS)[_MIDDLE:]], ids=["first", "second"])
def test_exit_codes_and_json_are_those_of_then(names: list[str], tmp_path: Path) -> None:
    codes, forms = run_all(tmp_path, names)
    then = {name: _GOLDEN["codes"][name] for name in names if name in _GOLDEN["codes"]}
    assert {n: codes[n] for n in then if codes[n] != then[n]} == {}, then
    assert lacking({n: f for n, f in _GOLDEN["json"].items() if n in names}, forms) == []


def test_the_page_of_json_has_each_field_with_its_type() -> None:
    for command, found in _GOLDEN["json"].items():
        assert undocumented(command.split()[0], found) == [], command


def test_every_command_of_then_is_run() -> None:
    assert _GOLDEN["codes"].keys() | _GOLDEN["json"].keys() <= COMMANDS.keys()
    assert sorted(set(_GOLDEN["codes"].values())) == [0, 1, 2]
