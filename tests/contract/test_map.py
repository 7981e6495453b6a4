"""The map of a room: its numbers, its surface, and that it repeats bit for bit.

Tolerances. On one machine a replay repeats bit for bit; another compiler of the kernels, or another processor, rounds
otherwise. What that comes to was measured on this very replay: weights of the network multiplied by 1 + 1e-6 N(0, 1),
depth by 1 + 3e-7 N(0, 1), convolutions without oneDNN, kernels compiled for the plainest x86-64 (no AVX, no FMA) with
torch's unvectorised code. Each tolerance is above all of these, and below what the smallest changes of behaviour do:
votes 2 % heavier, truncation 5 % longer, surface or cameras half a voxel off, one frame left out.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from semantic_mapper.fields.weights import default_checkpoint_path
from tests.contract import entry_points as api
from tests.contract.golden import LOG, POINTS, REFUSED_SEQ, WEIGHTS, digest, form, lacking, read
from tests.contract.runs import Points, flat, load_points, numbers_of, read_ply, replay_kitchen, replay_room, summary_of

VOXEL_M = 0.05
# Number: largest difference. What is not named must be equal.
TOLERANCES = {
    "blocks": 1,  # a block at the edge of the band; rounding: none of 324
    "surface_points": 5,  # of 9,428; rounding: none; truncation + 5 %: 99
    "classes": 5,  # of one class; rounding: none; truncation + 5 %: 37
    "confidence": 1e-4,  # of a quantile; rounding: 4e-6; votes + 2 %: 9e-4
    "miou": 2e-3,  # one ray is 4 pixels, perhaps of a rare class; rounding: none; frame left out: 4e-3
    "map_miou": 2e-3,  # rounding: none; frame left out: 4e-3; half a voxel off: 6e-3
    "total_accuracy": 5e-4,  # 35 of 69,120 pixels; rounding: none; frame left out: 1e-3
    "votes": 5.0,  # 1e-4 of all; rounding: 1e-3; votes + 2 %: 1,000
    "weight": 20.0,  # that many voxels of one frame; rounding: none; truncation + 5 %: 5,469
    "observed_voxels": 10,  # rounding: none; truncation + 5 %: 1,335
    "worst_depth_disagreement": 2e-4,  # two steps of its rounding to four places
}
# Of the surface, both ways. Golden coordinates are rounded to 0.1 mm and confidences to 1 / 65535.
DISTANCE_P99_M = 1e-4  # rounding: 6.2e-5, which is the 0.1 mm; truncation + 5 %: 1.2e-2; half a voxel: 4.3e-2
FAR_M, FAR_FRACTION = 0.005, 5e-4  # rounding: none; truncation + 5 %: 1.7e-2
LABEL_FRACTION = 5e-4  # with another class, 5 points; rounding: none; truncation + 5 %: 4e-3
CONFIDENCE_MEAN = 5e-5  # rounding: 4e-6; votes + 2 %: 2.5e-4; truncation + 5 %: 2e-3
COLOR_MEAN = 5e-3  # levels of 256; rounding: 2e-4; truncation + 5 %: 0.17
# The recording goes through far more rays and frames; relative where the numbers are large.
KITCHEN = {**TOLERANCES, "confidence": 1e-3}
KITCHEN_FRACTION = 2e-3  # of counts and sums


def unlike(then: dict[str, Any], now: dict[str, Any], tolerances: dict[str, float], fraction: float = 0.0) -> list[str]:
    """Numbers beyond their tolerance, or their fraction where that is more."""
    of_then, of_now = flat(then), flat(now)
    found = [f"{name}: was {of_then.get(name)}, is {of_now.get(name)}" for name in of_then.keys() ^ of_now.keys()]
    for name in of_then.keys() & of_now.keys():
        group = name.split(".")[0]
        allowed = tolerances.get(group, 0)
        if allowed >= 1:
            allowed = max(allowed, fraction * of_then[name])
        if not abs(of_then[name] - of_now[name]) <= allowed:
            found.append(f"{name}: was {of_then[name]}, is {of_now[name]}, allowed {allowed:g} apart")
    return sorted(found)


def other_surface(then: Points, now: Points) -> list[str]:
    """In what two surfaces differ beyond rounding."""
    found: list[str] = []
    for name, a, b in (("then", then, now), ("now", now, then)):
        distance, nearest = KDTree(b.xyz).query(a.xyz)
        common = distance < VOXEL_M
        other = a.label[common] != b.label[nearest][common]
        gap = np.abs(a.confidence - b.confidence[nearest])[common]
        color = np.abs(a.rgb.astype(float) - b.rgb[nearest])[common]
        looks = {
            "distance p99": (float(np.percentile(distance, 99)), DISTANCE_P99_M),
            "far": (float(np.mean(distance > FAR_M)), FAR_FRACTION),
            "other class": (float(np.mean(other)), LABEL_FRACTION),
            "confidence": (float(gap.mean()), CONFIDENCE_MEAN),
            "colour": (float(color.mean()), COLOR_MEAN),
        }
        found += [f"from {name}: {k} {v:.3g}, allowed {most:g}" for k, (v, most) in looks.items() if not v <= most]
    return found


def test_numbers_of_the_room_are_those_of_then(room_run: Path) -> None:
    assert unlike(read("map")["numbers"], numbers_of(room_run), TOLERANCES) == []


def test_surface_of_the_room_is_that_of_then(room_run: Path) -> None:
    points, header, _ = read_ply(room_run / "map.ply")
    assert other_surface(load_points(POINTS), points) == []
    golden_header = read("map")["ply_header"]
    assert [line for line in golden_header if not line.startswith("element") and line not in header] == []


def test_summary_has_the_keys_and_types_of_then(room_run: Path) -> None:
    then = read("map")
    assert lacking(then["summary"], form(summary_of(room_run))) == []
    assert {p.name for p in room_run.iterdir()} >= set(then["files"])
    assert [r["seq"] for r in summary_of(room_run)["refusals"]] == [REFUSED_SEQ]


def test_two_replays_are_equal_bit_for_bit(room_run: Path, tmp_path: Path) -> None:
    again = replay_room(tmp_path)
    for name in ("map.ply", "map.npz"):
        assert digest((again / name).read_bytes()) == digest((room_run / name).read_bytes())
    compared = api.run_here("eval", room_run, "--against", again, "--json")
    assert compared.code == 0, compared.stdout
    one, other = (summary_of(run) for run in (room_run, again))
    for part in ("frames", "map", "metrics", "metrics_per_image", "config", "labels", "refusals"):
        assert one[part] == other[part]


@pytest.mark.gate
@pytest.mark.slow
def test_lockstep_processes_make_the_map_of_one_process_bit_for_bit(room_run: Path, tmp_path: Path) -> None:
    values = {"camera.log": LOG, "mapper.weights": WEIGHTS, "mapper.config": room_run.parent / "room.toml"}
    settings = [word for name, value in values.items() for word in ("--set", f"{name}={value}")]
    ran = api.run_command("up", api.REPOSITORY / "launch" / "replay.toml", *settings, "--out", tmp_path / "up")
    assert ran.code == 0, ran.stderr
    for name in ("map.ply", "map.npz"):
        assert digest((tmp_path / "up" / name).read_bytes()) == digest((room_run / name).read_bytes())
    compared = api.run_here("eval", room_run, "--against", tmp_path / "up")
    assert compared.code == 0, compared.stdout
    assert lacking(read("map")["summary"], form(summary_of(tmp_path / "up"))) == []


@pytest.mark.slow
def test_numbers_of_a_real_kitchen_are_those_of_then(redkitchen: Path, tmp_path: Path) -> None:
    then = read("kitchen")
    weights = digest(default_checkpoint_path().read_bytes())
    assert weights == then["weights"], "the package has other weights; record `kitchen` again"
    run = replay_kitchen(redkitchen, tmp_path)
    assert unlike(then["numbers"], numbers_of(run), KITCHEN, KITCHEN_FRACTION) == []
