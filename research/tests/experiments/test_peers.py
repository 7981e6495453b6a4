from __future__ import annotations

from pathlib import Path

import pytest

from research.cli.main import app
from research.experiments import peers
from research.train.train import STATE_FILE

ALONE = peers.Budget(jobs=1)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands that would have been run; each leaves a state behind."""
    seen: list[list[str]] = []

    class Done:
        returncode = 0

    def run(command: list[str], **_: object) -> Done:
        assert Path(command[0]).name == app.info.name and command[1] in [verb.name for verb in app.registered_commands]
        seen.append(command)
        if "train" in command:
            (Path(command[command.index("--out") + 1]) / STATE_FILE).write_bytes(b"state")
        return Done()

    monkeypatch.setattr(peers.subprocess, "run", run)
    monkeypatch.setattr(peers, "unfinished_step", lambda _: None)
    return seen


def trained(calls: list[list[str]]) -> list[str]:
    return [Path(command[command.index("--out") + 1]).name for command in calls]


def test_a_field_brings_the_encoders_that_it_starts_from(tmp_path: Path, calls: list[list[str]]) -> None:
    assert peers.train_all(["sray"], tmp_path, ALONE) == 0
    assert trained(calls) == ["start", "unet-depth", "sray"]
    assert [c[c.index("--encoder") + 1] for c in calls[1:]] == [
        str(tmp_path / "start" / "weights.safetensors"),
        str(tmp_path / "unet-depth" / "weights.safetensors"),
    ]


def test_a_run_alone_renders_rooms_on_the_other_cores(
    tmp_path: Path, calls: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers.os, "cpu_count", lambda: 4)
    peers.train_all(["unet"], tmp_path / "alone", ALONE)
    peers.train_all(["unet"], tmp_path / "four", peers.Budget(jobs=4))
    workers = [c[c.index("--workers") + 1] if "--workers" in c else "" for c in calls]
    assert workers == ["3", "3", "", ""]


@pytest.mark.parametrize("tier", ["cpu", "gpu"])
def test_all_fields_have_the_same_steps_and_the_unets_have_none_on_rays(tier: str) -> None:
    def steps(name: str) -> tuple[int, int]:
        images = rays = 0
        while name:
            recipe = peers.tomllib.loads(peers.recipe(name, peers.Budget(tier=tier)))
            run = peers.RUNS[name]
            images, rays = images + recipe["steps"] * run.images, rays + recipe["steps"] * (not run.images)
            name = run.encoder
        return images, rays

    fields = [name for name, run in peers.RUNS.items() if not run.images]
    assert len({steps(name) for name in fields}) == 1
    assert {steps(name) for name in ("unet", "unet-depth")} == {(steps("sray")[0], 0)}


def test_a_recipe_is_that_of_its_tier_with_the_runs_own_kind_encoder_and_seed() -> None:
    file = peers.tomllib.loads((peers.RECIPES / "gpu-rays.toml").read_text(encoding="utf-8"))
    own = {"kind": "neuray", "seed": 3, "field": {"encoder": {"depth": False}}}
    assert peers.tomllib.loads(peers.recipe("neuray", peers.Budget(seed=3, tier="gpu"))) == file | own


def test_every_encoder_can_have_another_shape() -> None:
    shallow = peers.Budget(encoder={"channels": [32], "blocks": [2]})
    for name, run in peers.RUNS.items():
        own = {"channels": [32], "blocks": [2], "depth": run.depth}
        assert peers.tomllib.loads(peers.recipe(name, shallow))["field"] == {"encoder": own}


def test_what_is_done_is_not_trained_again_and_another_recipe_is_refused(
    tmp_path: Path, calls: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    peers.train_all(["unet"], tmp_path, ALONE)
    before = len(calls)
    assert peers.train_all(["unet"], tmp_path, ALONE) == 0 and len(calls) == before
    assert peers.train_all(["unet"], tmp_path, peers.Budget(seed=1, jobs=1)) == 1 and len(calls) == before
    assert "take another --out" in capsys.readouterr().out


def test_only_finished_runs_are_compared(
    tmp_path: Path, calls: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert peers.compare(["sray", "unet"], tmp_path) == 1 and not calls
    assert "sray, unet" in capsys.readouterr().out
    peers.train_all(["unet"], tmp_path, ALONE)
    calls.clear()
    assert peers.compare(["unet"], tmp_path) == 0
    assert [c[c.index("--depth") + 1] for c in calls] == ["on", "off"]
