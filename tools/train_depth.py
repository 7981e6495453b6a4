"""Trains the network of computed depth in rooms of training seeds: ``semantic_mapper/weights/depth.safetensors``.

Example: python -m tools.train_depth --samples samples --out depth.safetensors --walks 300 --minutes 25
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semantic_mapper.depth_from_motion.evidence import HINT_CHANNELS, MEMBRANE
from semantic_mapper.depth_from_motion.network import DepthNetwork, Prediction, save_network
from semantic_mapper.scenes import TRAIN_SEEDS
from semantic_mapper.training.depth_samples import walk_samples

FIRST_SEED, FIRST_HELD_OUT = 1_000, 90_000  # of the training seeds
BATCH, RATE, WARM_UP, WEIGHT_DECAY, AVERAGE = 4, 1.5e-3, 0.02, 1e-4, 0.998
LEAST, MOST = -4.0, 1.2  # logarithms of inverse depth that count
ERROR_WEIGHT, EDGE_WEIGHT, SPREAD_WEIGHT = 8.0, 2.0, 0.5
DROP_HINT, COLOUR = 0.3, 0.15
QUANTILE = 0.683
SAY_EVERY = 200  # steps

Half = NDArray[np.float16]


class Samples(NamedTuple):
    """Samples in memory.

    Args:
        evidence: (N, C, h, w) float16; truth: (N, h, w) float16.
    """

    evidence: list[Half]
    truth: list[Half]


def make(folder: Path, first: int, walks: int) -> None:
    """Write one file a walk; those that are there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in TRAIN_SEEDS[first : first + walks]:
        path = folder / f"{seed:06d}.npz"
        if path.exists():
            continue
        found = list(walk_samples(seed))
        evidence = np.array([s.evidence for s in found], np.float16)
        partial = path.with_suffix(".partial.npz")
        np.savez(partial, evidence=evidence, truth=np.array([s.truth for s in found], np.float16))
        partial.rename(path)


def load(folder: Path, known: set[Path], into: Samples) -> None:
    """Add the files of ``folder`` that are not known yet."""
    for path in sorted(folder.glob("[0-9]*[0-9].npz")):
        if path not in known:
            known.add(path)
            with np.load(path) as file:
                into.evidence.extend(file["evidence"])
                into.truth.extend(file["truth"])


def batch(samples: Samples, chosen: NDArray[np.int64], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Evidence (B, C, h, w) and truth (B, h, w) float32, mirrored, coloured and robbed of hints at random."""
    evidence = torch.from_numpy(np.stack([samples.evidence[k] for k in chosen])).float()
    truth = torch.from_numpy(np.stack([samples.truth[k] for k in chosen])).float()
    for k in range(len(chosen)):
        if rng.uniform() < DROP_HINT:
            without_hint(evidence[k])
        if rng.uniform() < 0.5:
            evidence[k] = evidence[k].flip(-1)
            evidence[k, 3] *= -1
            truth[k] = truth[k].flip(-1)
        gain = torch.from_numpy(1 + COLOUR * rng.standard_normal((3, 1, 1))).float()
        evidence[k, :3] = evidence[k, :3] * gain + COLOUR * rng.standard_normal()
    return evidence.to(memory_format=torch.channels_last), truth


def without_hint(evidence: Tensor) -> None:
    """Take the hint out of (C, h, w), in place."""
    evidence[HINT_CHANNELS] = 0
    evidence[HINT_CHANNELS.start] = evidence[MEMBRANE]


def loss_of(found: Prediction, truth: Tensor) -> Tensor:
    """Error, error of the steps between neighbours, and negative log likelihood of a Laplace distribution."""
    known = ((truth > LEAST) & (truth < MOST)).float()
    off = (found.log_inverse - truth) * known
    count = known.sum().clamp_min(1)
    likelihood = (off.abs() * torch.exp(-found.log_spread) + found.log_spread) * known
    edges = [d.abs().mean() for d in (off[:, 1:] - off[:, :-1], off[:, :, 1:] - off[:, :, :-1])]
    error = (torch.expm1(off.abs().clamp_max(0.7))).sum() / count
    return ERROR_WEIGHT * error + EDGE_WEIGHT * sum(edges) + SPREAD_WEIGHT * likelihood.sum() / count


def train(folder: Path, minutes: float, seed: int) -> DepthNetwork:
    """The average of the last steps' weights. Files that come while it trains are used as well."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = DepthNetwork().to(memory_format=torch.channels_last)
    average = {name: p.detach().clone() for name, p in network.named_parameters()}
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    samples, known = Samples([], []), set[Path]()
    start, step, losses = time.monotonic(), 0, list[float]()
    while (done := (time.monotonic() - start) / (60 * minutes)) < 1:
        load(folder, known, samples)
        order = rng.permutation(len(samples.truth))
        for first in range(0, len(order) - BATCH + 1, BATCH):
            done = (time.monotonic() - start) / (60 * minutes)
            if done >= 1:
                break
            rate = RATE * min(done / WARM_UP + 0.01, 1.0) * 0.5 * (1 + np.cos(np.pi * done))
            optimiser.param_groups[0]["lr"] = rate
            evidence, truth = batch(samples, order[first : first + BATCH], rng)
            with torch.autocast("cpu", torch.bfloat16):
                found = network(evidence)
            loss = loss_of(found, truth)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            step += 1
            keep = min(AVERAGE, step / (step + 10))
            with torch.no_grad():
                for name, p in network.named_parameters():
                    average[name].lerp_(p, 1 - keep)
            losses.append(float(loss.detach()))
            if step % SAY_EVERY == 0:
                print(f"{done:.2f} step {step} of {len(order)} samples: {np.mean(losses[-SAY_EVERY:]):.3f}", flush=True)
    network.load_state_dict(average)
    return network


def evaluate(network: DepthNetwork, folder: Path) -> float:
    """Print the errors on held-out walks; returns the spread's factor so that 68 % of the errors are within it."""
    samples = Samples([], [])
    load(folder, set(), samples)
    rows: dict[str, list[float]] = {}
    ratios: list[NDArray[np.float32]] = []
    for evidence, truth in zip(samples.evidence, samples.truth, strict=True):
        x, t = torch.from_numpy(evidence).float(), torch.from_numpy(truth).float()
        known = (t > LEAST) & (t < MOST)
        hinted = bool((x[HINT_CHANNELS.start + 1] > 0).any())
        with torch.inference_mode():
            found = network(x[None])
        off = (found.log_inverse[0] - t)[known].abs()
        name = "with a hint" if hinted else "without"
        rows.setdefault(f"membrane {name}", []).append(float(torch.expm1((x[MEMBRANE] - t)[known].abs()).mean()))
        rows.setdefault(f"network {name}", []).append(float(torch.expm1(off).mean()))
        rows.setdefault(f"membrane's median {name}", []).append(float((x[MEMBRANE] - t)[known].abs().median()))
        rows.setdefault(f"network's median {name}", []).append(float(off.median()))
        ratios.append((off / torch.exp(found.log_spread[0][known])).numpy()[::11])
    for name, values in rows.items():
        print(f"{name}: {np.mean(values):.4f} of {len(values)} samples")
    factor = float(np.quantile(np.concatenate(ratios), QUANTILE))
    print(f"spread's factor {factor:.3f}")
    return factor


def main() -> None:
    """Make samples, train, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=Path, required=True, help="folder for samples; what is there is used")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--walks", type=int, default=300, help="walks to make samples of; 22 MB each")
    parser.add_argument("--held-out", type=int, default=12, help="walks of rooms that only figures are made of")
    parser.add_argument("--minutes", type=float, default=25)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    make(given.samples / "train", FIRST_SEED, given.walks)
    make(given.samples / "held_out", FIRST_HELD_OUT, given.held_out)
    network = train(given.samples / "train", given.minutes, given.seed)
    factor = evaluate(network, given.samples / "held_out")
    with torch.no_grad():
        network.head.bias[-1] += np.log(factor)
    save_network(network, given.out)


if __name__ == "__main__":
    main()
