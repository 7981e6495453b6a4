import json
import math
from pathlib import Path

import pytest
import torch

from research.tests.train.small_run import contents, small_run
from research.train.train import (
    STATE_FILE,
    WEIGHTS_FILE,
    TrainProgress,
    learning_rate,
    train,
)
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint


def stop_after(steps: int):
    """What to hand to ``train`` to stop after this many steps of this sitting."""
    done: list[int] = []

    def on_progress(progress: TrainProgress) -> None:
        done.append(progress.step)

    return {"on_progress": on_progress, "stopped": lambda: len(done) >= steps}


@pytest.mark.slow
def test_a_run_that_was_stopped_and_resumed_equals_one_that_was_not_bit_for_bit(tmp_path: Path):
    config = small_run(steps=9, rooms_per_step=2)
    whole = train(config, tmp_path / "whole")
    first = train(config, tmp_path / "parts", **stop_after(2))
    assert first.recipe["steps"] == 2
    second = train(config, tmp_path / "parts", resume=True, **stop_after(3))
    assert second.recipe["steps"] == 5
    parts = train(config, tmp_path / "parts", resume=True)
    (a, about_a), (b, about_b) = (contents(tmp_path / run / STATE_FILE) for run in ("whole", "parts"))
    assert a.keys() == b.keys() and any(n.startswith("optimiser.") for n in a) and any(n.startswith("best.") for n in a)
    assert [n for n in a if not torch.equal(a[n], b[n])] == []
    assert about_a == about_b
    assert whole.recipe["validation_miou"] == parts.recipe["validation_miou"]


@pytest.mark.slow
def test_training_lowers_the_loss_and_keeps_the_best_weights(tmp_path: Path):
    run = small_run(steps=36, log_steps=12, validation={"times": 3, "rooms": 1, "queries": 1, "rays": 64})
    checkpoint = train(run, tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "history.jsonl").read_text().splitlines()]
    losses = [line["loss_total"] for line in lines if "loss_total" in line]
    scores = [line for line in lines if "miou" in line]
    assert losses[-1] < losses[0] and len(scores) == 3
    best = max(scores, key=lambda line: line["miou"] + line["blind_miou"])
    assert checkpoint.recipe["best_step"] == best["step"]
    kept = load_checkpoint(tmp_path / WEIGHTS_FILE).model.state_dict()
    assert all(torch.equal(kept[n], t) for n, t in checkpoint.model.state_dict().items())


def test_the_recipe_tells_where_the_weights_come_from():
    recipe = train(small_run(steps=2, images={"fraction": 0.0})).recipe
    assert recipe["steps"] == 2 and recipe["seed"] == 0 and recipe["rooms"] == 3 and recipe["ranks"] == 1
    assert recipe["suite"].startswith("rooms v") and recipe["torch"] == torch.__version__
    assert recipe["device"].startswith("cpu") and recipe["width"] == 48
    assert set(recipe["validation"]) >= {"miou", "blind_miou", "accuracy", "blind_accuracy"}
    assert "git_revision" in recipe and json.dumps(recipe, allow_nan=False)


def test_a_run_goes_on_with_a_larger_budget_but_with_no_other_config(tmp_path: Path):
    train(small_run(steps=4), tmp_path)
    longer = train(small_run(steps=8), tmp_path, resume=True)
    assert longer.recipe["steps"] == 8
    assert [line["step"] for line in longer.recipe["history"]] == [2, 4, 8]
    with pytest.raises(ConfigError, match=r"another config .*learning_rate was 0\.001, is 0\.01"):
        train(small_run(learning_rate=0.01), tmp_path, resume=True)


def test_a_folder_takes_one_training_at_a_time(tmp_path: Path):
    refused: list[str] = []

    def second(_: TrainProgress) -> None:
        with pytest.raises(ConfigError, match="another training") as caught:
            train(small_run(steps=1), tmp_path)
        refused.append(str(caught.value))

    train(small_run(steps=1), tmp_path, on_progress=second)
    assert refused and str(tmp_path) in refused[0]
    train(small_run(steps=2), tmp_path, resume=True)  # free again


def test_neither_an_unfinished_nor_a_finished_run_is_overwritten_by_mistake(tmp_path: Path):
    config = small_run(steps=2, images={"fraction": 0.0})
    train(config, tmp_path, **stop_after(1))
    with pytest.raises(ConfigError, match="stopped here at step 1; go on with --resume"):
        train(config, tmp_path)
    train(config, tmp_path, resume=True)
    finished = (tmp_path / STATE_FILE).read_bytes()
    with pytest.raises(ConfigError, match=r"finished here; .*--resume and a larger budget.*another --out.*delete"):
        train(config, tmp_path)
    assert (tmp_path / STATE_FILE).read_bytes() == finished
    (tmp_path / STATE_FILE).unlink()
    assert train(small_run(steps=1, images={"fraction": 0.0}), tmp_path).recipe["steps"] == 1


def test_a_state_that_is_damaged_says_so(tmp_path: Path):
    (tmp_path / STATE_FILE).write_bytes(b"nothing of the kind")
    with pytest.raises(WeightsError, match="not a readable training state"):
        train(small_run(), tmp_path, resume=True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"steps": 0}, "needs a budget"),
        ({"rooms_per_step": 0}, "rooms_per_step"),
        ({"seed": -1}, "seed must be"),
        ({"step": {"views_min": 5, "views_max": 4}}, "views_min <= views_max"),
        ({"validation": {"rooms": 21}}, "1 to 20 rooms"),
        ({"pool": {"rooms": 2, "rooms_at_start": 4}}, "rooms_at_start <= rooms"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes: dict, words: str):
    with pytest.raises(ConfigError, match=words):
        train(small_run(**changes))


def test_the_rate_warms_up_and_then_falls_to_its_end():
    config = small_run()
    assert learning_rate(0.0, 0.5, config) == pytest.approx(0.1 * config.images.learning_rate)
    assert learning_rate(0.005, 0.5, config) > 0.99 * config.images.learning_rate
    assert learning_rate(0.4999, 0.5, config) == pytest.approx(config.final_learning_rate, rel=1e-2)
    assert learning_rate(0.5, 0.5, config) == pytest.approx(0.1 * config.learning_rate), (
        "rays begin with a rate of their own"
    )
    assert learning_rate(0.505, 0.5, config) > 0.99 * config.learning_rate
    assert math.isclose(learning_rate(1.0, 0.5, config), config.final_learning_rate)
    assert learning_rate(0.01, 0.0, config) > 0.99 * config.learning_rate, "rays from the first step on"


def test_a_run_may_start_from_weights_of_the_same_shape_and_from_no_others(tmp_path: Path):
    first = train(small_run(steps=2))
    save_checkpoint(first, tmp_path / "first.safetensors")
    still = {"steps": 1, "learning_rate": 0.0, "final_learning_rate": 0.0, "images": {"fraction": 0.0}}
    still["start"] = str(tmp_path / "first.safetensors")
    second = train(small_run(seed=5, **still))
    assert all(torch.equal(a, b) for a, b in zip(first.model.parameters(), second.model.parameters(), strict=True))
    with pytest.raises(ConfigError, match="another field"):
        train(small_run(**{**still, "field": {"feature_dim": 8, "heads": 2}}))
    with pytest.raises(WeightsError, match="no such weights file"):
        train(small_run(**{**still, "start": str(tmp_path / "none.safetensors")}))
