"""``train --kind nesf``: map rooms or logs, then train the network that refines maps."""

from __future__ import annotations

from pathlib import Path

from research.train.folder_lock import sole_use_of
from research.train.map_grids import make_log_maps, make_room_maps
from research.train.nesf import NesfProgress, NesfTrainConfig, TrainingMap, train_nesf
from semantic_mapper.config import convert_config, load_config, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.nesf import save_nesf
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest

WEIGHTS_FILE = "weights.safetensors"
VALIDATION_SEED = 100_000  # rooms from here on have materials that none below has
SELDOM = 4  # rooms are mapped once more with every so many-th frame rendered


def train_on_maps(
    output: Output,
    config: Path | None,
    out: Path,
    *,
    resume: bool,
    seconds: float | None,
    steps: int | None,
    seed: int | None,
) -> int:
    """Make the maps that are missing, train, write the weights; returns the exit code.

    Raises ConfigError, WeightsError, LogError, MapError: with what is wrong and the mend.
    """
    plain = to_plain(load_config(config, NesfTrainConfig) if config else NesfTrainConfig())
    given = {"seconds": seconds, "steps": steps, "seed": seed}
    plain |= {name: value for name, value in given.items() if value is not None}
    settings = convert_config(plain, NesfTrainConfig, "command line")
    is_file = out.suffix == ".safetensors"
    folder = out.with_name(f"{out.stem}-training") if is_file else out
    file = out if is_file else out / WEIGHTS_FILE
    maps_folder = Path(settings.maps) if settings.maps else folder / "maps"
    weights = Path(settings.weights) if settings.weights else default_checkpoint_path()
    with sole_use_of(folder), StopRequest() as stop:
        paths, held_out = _maps(settings, maps_folder, weights, stop)
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the maps so far are in {maps_folder}", style="yellow")
            return stop.exit_code
        with frame_progress("training", None, unit="%") as bar:
            bar.start(100)

            def on_progress(progress: NesfProgress) -> None:
                score = "" if progress.miou is None else f" mIoU {progress.miou * 100:.1f} %"
                bar.set(int(progress.fraction * 100), f"step {progress.step} loss {progress.loss:.3f}{score}")

            trained = train_nesf(
                settings,
                load_checkpoint(weights).label_set,
                [TrainingMap.load(path) for path in paths],
                [TrainingMap.load(path) for path in held_out],
                folder,
                resume=resume,
                on_progress=on_progress,
                stopped=lambda: stop,
            )
        save_nesf(trained, file)
        found = trained.recipe["validation"]
        output.print(
            f"{file}: {trained.recipe['steps']} steps on {len(paths)} maps; the best weights, of step "
            f"{trained.recipe['best_step']}: mIoU at the labelled surface of {len(held_out)} others "
            f"{found['miou'] * 100:.1f} %, unrefined {found['map_miou'] * 100:.1f} %"
        )
        return stop.exit_code


def _maps(settings: NesfTrainConfig, folder: Path, weights: Path, stop: StopRequest) -> tuple[list[Path], list[Path]]:
    """Files of the maps to train on and to validate on."""
    if settings.logs:
        with frame_progress("map the logs", None, unit="logs") as bar:
            bar.start(len(settings.logs))
            logs = [Path(log) for log in settings.logs]
            paths = make_log_maps(logs, folder, weights, lambda log: bar.advance(), lambda: stop)
        if stop:
            return paths, []
        if len(paths) < 2:
            raise ConfigError("training needs the maps of at least two logs, one of them to validate on")
        held_out = max(1, len(paths) // 10)
        return paths[:-held_out], paths[-held_out:]
    validated = range(VALIDATION_SEED, VALIDATION_SEED + settings.validation_rooms)
    trained_on = range(settings.first_seed, settings.first_seed + settings.rooms)
    found: tuple[list[Path], list[Path]] = [], []
    with frame_progress("map the rooms", None, unit="rooms") as bar:
        bar.start(len(validated) + len(trained_on))
        for seeds, rendered, paths in ((validated, (1,), found[1]), (trained_on, (1, SELDOM), found[0])):
            for seed in seeds:
                if stop:
                    break
                paths += make_room_maps([seed], folder, weights, rendered=rendered)
                bar.advance()
    return found
