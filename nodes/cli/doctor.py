"""``semantic-mapper doctor``: what is missing on this machine and how to fix it, and which cameras it has."""

from dataclasses import asdict

from rich.text import Text

from semantic_mapper.drivers.registry import find_cameras
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOutput, verb
from semantic_mapper.nodes.console import Output, table
from semantic_mapper.nodes.doctor import examine

_STYLES = {"ok": "green", "note": "yellow", "bad": "bold red"}


@verb
def doctor(
    output: JsonOutput,
    *,
    cameras: bool = False,  # list the cameras that are connected instead, as a config names them
) -> int:
    """Say what this machine lacks, and the fix; list its cameras.

    Exit code 1 where something needed is missing. Video files, streams (kind opencv) and pairs (kind stereo) are named,
    not found. A kind of camera whose packages are missing is reported, too.

    Example: semantic-mapper doctor
    Example: semantic-mapper doctor --cameras --json
    """
    if cameras:
        _list_cameras(output)
        return 0
    checks = examine()
    rows = [(Text(check.state, _STYLES[check.state]), check.name, check.found, check.fix) for check in checks]
    output.print(table(rows, ("", "what", "found", "fix"), title="doctor"))
    output.json([asdict(check) for check in checks])
    return EXIT_FAILED if any(check.state == "bad" for check in checks) else 0


def _list_cameras(output: Output) -> None:
    found, unknown = find_cameras()
    if found:
        rows = [(camera.kind, camera.name, camera.address, camera.note) for camera in found]
        output.print(table(rows, ("kind", "name", "address", "note"), title="cameras"))
    else:
        output.print("no camera is connected")
    for name, reason in unknown.items():
        output.print(f"{name}: cannot be searched: {reason}")
    output.json({"cameras": [asdict(camera) for camera in found], "unknown": unknown})
