"""``semantic-mapper fleet run`` and ``top``: many logs, many machines, one store of results."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semantic_mapper.nodes.cli.verb import Settings, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest

if TYPE_CHECKING:
    from semantic_mapper.nodes.fleet.runner import DriverStatus

EXIT_QUARANTINED = 1

StoreArgument = Annotated[str, typer.Argument(metavar="STORE", help="Path or URL that `fleet run --out` named.")]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="HOST:PORT of a Ray cluster to join; `auto`: the one that RAY_ADDRESS names; `local`, or without it: Ray "
        "starts on this machine, on loopback only.",
    ),
]
TrustedOption = Annotated[
    bool,
    typer.Option(
        "--trusted-network",
        help="Join a cluster on another machine though it asks for no token or uses no TLS: nobody else can reach it.",
    ),
]


class OperationName(StrEnum):
    """What is done with each log; see the verb of the same name."""

    REPLAY = "replay"
    EVAL = "eval"
    AUTOLABEL = "autolabel"
    FINETUNE = "finetune"
    REFINE = "refine"


@verb
def run(
    operation: Annotated[
        OperationName, typer.Argument(metavar="OPERATION", help="replay, eval, autolabel, finetune or refine.")
    ],
    logs: Annotated[
        list[str],
        typer.Argument(
            metavar="LOG...",
            help="Paths, URLs (s3, gs, http), globs in quotes, or manifests (CSV or Parquet with a column `log`; "
            "others are tags). refine: maps (.npz).",
        ),
    ],
    out: Annotated[str, typer.Option("--out", metavar="STORE", help="Path or URL of the store; made if missing.")],
    ray: RayOption = None,
    weights: Annotated[
        str | None,
        typer.Option("--weights", help="Path or URL of a weights file, or a name of weights in the package."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A setting: max_frames=100, quality=fast, voxel_map.voxel_size_m=0.05, keyframes=8; may be repeated.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="TOML file with settings of the verb; --set goes before it.")
    ] = None,
    max_parallel: Annotated[
        int, typer.Option("--max-parallel", min=0, help="Tasks at a time; 0 = what there is room for.")
    ] = 0,
    cpus: Annotated[float, typer.Option(min=0.1, help="CPUs of a task.")] = 1.0,
    gpus: Annotated[
        float, typer.Option(min=0.0, help="GPUs of a task, also a fraction; views are rendered there then.")
    ] = 0.0,
    memory: Annotated[
        float | None,
        typer.Option(metavar="GB", min=0.1, help="Memory of a task.  [default: 2; finetune and refine: 4]"),
    ] = None,
    worker_disk: Annotated[
        float,
        typer.Option(metavar="GB", min=0.0, help="Disk that tasks of a machine may take together; 0 = what is free."),
    ] = 0.0,
    timeout: Annotated[
        float,
        typer.Option(metavar="HOURS", min=0.0, help="A log that takes longer has failed; 0 = none."),
    ] = 0.0,
    retry_quarantined: Annotated[
        bool, typer.Option("--retry-quarantined", help="Also try logs that failed in an earlier run.")
    ] = False,
    trusted_network: TrustedOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Do an operation with many logs, once each, and keep the results in a store.

    A result is named by the content of the log, the weights, the settings and the code: what is in the store is not
    done again, so that the same command resumes a run that was stopped or killed. A log that fails twice is
    quarantined with its error; the exit code is 1 then. Ctrl-C ends the tasks that run (exit code 130).

    Example: semantic-mapper fleet run replay "logs/*.mcap" --out runs/fleet
    Example: semantic-mapper fleet run eval robots.csv --out s3://maps/week --ray head:6379 --weights new.safetensors
    Example: semantic-mapper fleet run replay "logs/*.mcap" --out runs/fleet --set voxel_map.voxel_size_m=0.05
    """
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.nodes.fleet.inputs import check_inputs, find_inputs

    check_inputs(logs)
    from semantic_mapper.nodes.fleet.cluster import connected
    from semantic_mapper.nodes.fleet.operations import OPERATIONS, read_settings
    from semantic_mapper.nodes.fleet.runner import FleetRun, Resources
    from semantic_mapper.nodes.fleet.start import make_template
    from semantic_mapper.nodes.fleet.store import Store

    kind = OPERATIONS[operation.value]
    inputs = find_inputs(logs, kind.suffix)
    assignments = [*(("render.device=cuda",) if gpus and kind.rest == "mapper" else ()), *(settings or ())]
    read_settings(operation.value, assignments, config)  # before a store is made
    store = Store(out, create=True)
    template = make_template(operation.value, store, weights, assignments, config, round(worker_disk * 1e9))
    resources = Resources(cpus, gpus, round((memory or kind.memory_gb) * 1e9), max_parallel, timeout * 3600)
    with (
        StopRequest() as stop,
        connected(ray, trusted_network=trusted_network, worker_logs=Settings.verbose) as cluster,
        frame_progress(f"fleet {operation.value}", len(inputs), unit="logs") as bar,
    ):
        fleet = FleetRun(store, template, inputs, resources, cluster, retry_quarantined=retry_quarantined)
        status = fleet.run(lambda: stop, lambda now: bar.set(now.done + now.existing + now.failed, _note(now)))
    output.print(_sentence(status, store.shown))
    for failure in fleet.failures:
        output.print(f"  quarantined: {failure.log}: {failure.errors[-1]}")
    if json:
        quarantined = [{"log": failure.log, "errors": list(failure.errors)} for failure in fleet.failures]
        output.json({"store": store.shown, **_plain(status), "quarantined": quarantined})
    if stop:
        stderr_console().print(f"stopped by {stop.name}; the same command resumes it", style="yellow")
        return stop.exit_code
    return EXIT_QUARANTINED if status.failed else 0


def _note(status: DriverStatus) -> str:
    parts = [f"{status.running} running"]
    parts += [f"{count} {name}" for name, count in (("failed", status.failed), ("retries", status.retries)) if count]
    return ", ".join(parts)


def _sentence(status: DriverStatus, store: str) -> str:
    return (
        f"{store}: {status.done} done, {status.existing} were there, {status.failed} quarantined, of {status.total}; "
        f"{status.retries} retries"
    )


def _plain(status: DriverStatus) -> dict[str, Any]:
    import msgspec

    return msgspec.to_builtins(status)


@verb
def top(
    store: StoreArgument,
    once: Annotated[bool, typer.Option("--once", help="Show it once, and end.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout, once.")] = False,
) -> None:
    """Show the runs that fill a store: logs done, rate, time left, failures.

    Works from any machine that can read the store. Ends when no run is going on any more, or by Ctrl-C.

    Example: semantic-mapper fleet top runs/fleet
    """
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.nodes.cli.fleet_top import show_drivers

    show_drivers(store, output, once=once, json=json)
