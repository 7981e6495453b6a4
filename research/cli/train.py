"""``semantic-mapper-research train``: train a field on procedural rooms."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.cli.verb import must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest


@verb
def train(
    out: Annotated[Path, typer.Option("--out", help="Folder for everything, or a weights file (.safetensors).")],
    config: Annotated[
        Path | None, typer.Option(help="TOML file with a TrainConfig, research/recipes/cpu-2h.toml say.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where the run in --out stopped, or train it further.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(min=0, help="Time for training; 0 = only --steps counts.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps of training; 0 = only --seconds counts.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of everything that is drawn at random.")] = None,
    workers: Annotated[int | None, typer.Option(min=0, help="Processes that render rooms; 0 = none beside it.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Weights to start from; without it random ones.")] = None,
    kind: Annotated[
        str | None, typer.Option(help="Kind of field, sray or one of its peers; nesf refines maps.")
    ] = None,
    encoder: Annotated[Path | None, typer.Option(help="Weights of any kind whose image encoder to take over.")] = None,
    half: Annotated[bool, typer.Option("--half", help="Store weights as float16, for shipping.")] = False,
) -> int:
    """Train a field on procedural rooms, which are rendered as it goes.

    Keeps the weights that were best on the validation rooms, or with keep = "last" in the TOML file, as some recipes
    have it, those of the last validation. Beside them it writes its state, its history (history.jsonl) and its curves
    (curves.png). Ctrl-C saves the state and the weights kept so far (exit code 130); the same command with --resume
    goes on. A run in --out is never overwritten. Start it with torchrun to use several GPUs.

    With --kind nesf, or a TOML file that says so, the network of `refine` is trained, on maps of procedural rooms or
    of the labelled logs that the file names.

    Example: semantic-mapper-research train --config research/recipes/cpu-2h.toml --out runs/rooms --half
    Example: semantic-mapper-research train --config research/recipes/nesf-rooms.toml --out runs/nesf
    """
    must_be_there(*(path for path in (config,) if path is not None))
    output = Output.guarded()
    from research.train.ranks import ranks_from_environment
    from research.train.train import WEIGHTS_FILE, TrainProgress
    from research.train.train import train as train_here
    from research.train.train_config import TrainConfig
    from semantic_mapper.config import convert_config, load_config, to_plain
    from semantic_mapper.errors import ConfigError
    from semantic_mapper.fields.checkpoint import save_checkpoint
    from semantic_mapper.fields.weights import MAP_KIND

    if kind == MAP_KIND or (kind is None and config is not None and _kind_of(config) == MAP_KIND):
        from research.cli.train_nesf import train_on_maps

        if workers or weights or encoder:
            raise ConfigError(
                "--workers, --weights and --encoder are for fields; --kind nesf starts from random weights"
            )
        return train_on_maps(output, config, out, resume=resume, seconds=seconds, steps=steps, seed=seed)
    plain = to_plain(load_config(config, TrainConfig) if config else TrainConfig())
    start = None if weights is None else str(weights)
    given = {"seconds": seconds, "steps": steps, "seed": seed, "workers": workers, "start": start, "kind": kind}
    given["encoder_from"] = None if encoder is None else str(encoder)
    plain |= {name: value for name, value in given.items() if value is not None}
    settings = convert_config(plain, TrainConfig, "command line")
    is_file = out.suffix == ".safetensors"
    folder = out.with_name(f"{out.stem}-training") if is_file else out
    here = ranks_from_environment()
    keep_freed_memory()
    # torchrun hands on Ctrl-C and then asks once more in its own way: both mean the same.
    with StopRequest(patient=here.world > 1) as stop, frame_progress("training", None, unit="%") as bar:
        bar.start(100)

        def on_progress(progress: TrainProgress) -> None:
            loss = "" if progress.loss is None else f" loss {progress.loss:.3f}"
            score = "" if progress.scores is None else f" mIoU {progress.scores.miou * 100:.1f} %"
            bar.set(int(progress.fraction * 100), f"step {progress.step}{loss}{score}")

        checkpoint = train_here(settings, folder, resume=resume, on_progress=on_progress, stopped=lambda: stop)
    if here.first:
        file = out if is_file else out / WEIGHTS_FILE
        save_checkpoint(checkpoint, file, half=half)
        output.print(f"{file}: {_told(checkpoint.recipe)}")
        if stop:
            summary = f"stopped by {stop.name}; the state and {_kept(checkpoint.recipe)} are saved, --resume goes on"
            stderr_console().print(summary, style="yellow", soft_wrap=True)
    return stop.exit_code


def _kind_of(config: Path) -> str:
    """What a TOML file says; its errors are reported where it is read as settings."""
    try:
        return str(tomllib.loads(config.read_text(encoding="utf-8")).get("kind", ""))
    except (OSError, ValueError):
        return ""


def _told(recipe: dict[str, Any]) -> str:
    """The recipe in a line."""
    line = f"{recipe['steps']} steps on {recipe['rooms']} rooms in {recipe['seconds']:.0f} s"
    validation = recipe["validation"]
    if not validation:
        return f"{line}, not validated yet"
    figures = f"{validation['miou'] * 100:.1f} % with depth, {validation['blind_miou'] * 100:.1f} % without"
    return f"{line}; {_kept(recipe)}, of step {recipe['best_step']}: mIoU {figures}"


def _kept(recipe: dict[str, Any]) -> str:
    """Which weights these are."""
    if not recipe["validation"]:
        return "the latest weights"
    return "the best weights so far" if recipe["config"]["keep"] == "best" else "the weights of the last validation"
