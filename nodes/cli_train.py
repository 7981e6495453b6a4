"""``semantic-mapper train``: train the field on procedural rooms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from nodes.console import Output, frame_progress
from nodes.verb import verb


@verb
def train(
    out: Annotated[Path, typer.Option("--out", help="Weights file to write (.safetensors).")],
    seconds: Annotated[float | None, typer.Option(min=0, help="Time for training; 0 = only --steps counts.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps of training; 0 = only --seconds counts.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of everything that is drawn at random.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file with a TrainConfig.")] = None,
    half: Annotated[bool, typer.Option("--half", help="Store weights as float16, for shipping.")] = False,
) -> None:
    """Train S-Ray from scratch on procedural rooms, which are rendered as it goes.

    Keeps the weights that were best on the validation rooms. Ctrl-C writes nothing.

    Example: semantic-mapper train --out rooms.safetensors --seconds 1800 --seed 0 --half
    """
    output = Output.guarded()
    from semantic_mapper.config import convert_config, load_config, to_plain
    from semantic_mapper.errors import ConfigError
    from semantic_mapper.fields.checkpoint import save_checkpoint
    from semantic_mapper.training.train import TrainConfig, TrainProgress
    from semantic_mapper.training.train import train as train_field

    plain = to_plain(load_config(config, TrainConfig) if config else TrainConfig())
    given = {"seconds": seconds, "steps": steps, "seed": seed}
    plain |= {name: value for name, value in given.items() if value is not None}
    settings = convert_config(plain, TrainConfig, "command line")
    if settings.seconds == 0 and settings.steps == 0:
        raise ConfigError("training needs a budget: set seconds, steps, or both")
    with frame_progress("training", None, unit="%") as bar:
        bar.start(100)

        def on_progress(progress: TrainProgress) -> None:
            score = "" if math.isnan(progress.validation_miou) else f" mIoU {progress.validation_miou * 100:.1f} %"
            bar.set(int(progress.fraction * 100), f"step {progress.step} loss {progress.loss:.3f}{score}")

        checkpoint = train_field(settings, on_progress)
    save_checkpoint(checkpoint, out, half=half)
    recipe = checkpoint.recipe
    output.print(
        f"{out}: {recipe['steps']} steps on {recipe['rooms']} rooms in {recipe['seconds']:.0f} s, "
        f"validation mIoU {recipe['validation_miou'] * 100:.1f} %"
    )
