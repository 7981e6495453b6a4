"""Trains the network of computed depth in rooms of training seeds: ``semantic_mapper/weights/depth.safetensors``.

Example: python -m tools.train_depth --samples samples --out semantic_mapper/weights/depth.safetensors
"""

from __future__ import annotations

import argparse
import copy
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semantic_mapper.depth_from_motion.evidence import HINT_CHANNELS, MEMBRANE
from semantic_mapper.depth_from_motion.network import DepthNetwork, Prediction, load_network, save_network
from semantic_mapper.scenes import TRAIN_SEEDS
from semantic_mapper.training.depth_samples import walk_samples

FIRST_SEED, FIRST_HELD_OUT = 1_000, 90_000  # of the training seeds
BATCH, RATE, WARM_UP, FALL, WEIGHT_DECAY = 4, 1.5e-3, 50, 0.5, 1e-4  # warm-up in steps, fall as a fraction of them
AVERAGE, MOST_GRADIENT = 0.99, 5.0
LEAST, MOST = -4.0, 1.2  # logarithms of inverse depth that count
ERROR_WEIGHT, EDGE_WEIGHT, SPREAD_WEIGHT = 8.0, 2.0, 0.5
DROP_HINT, WRONG_HINT, HINT_OFF, COLOUR = 0.25, 0.3, 0.35, 0.15
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


def load(folder: Path) -> Samples:
    """The samples that ``make`` wrote into ``folder``."""
    found = Samples([], [])
    for path in sorted(folder.glob("[0-9]*[0-9].npz")):
        with np.load(path) as file:
            found.evidence.extend(file["evidence"])
            found.truth.extend(file["truth"])
    return found


def batch(samples: Samples, chosen: NDArray[np.int64], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Evidence (B, C, h, w) and truth (B, h, w) float32, mirrored, coloured, and with wrong hints or none at random."""
    evidence = torch.from_numpy(np.stack([samples.evidence[k] for k in chosen])).float()
    truth = torch.from_numpy(np.stack([samples.truth[k] for k in chosen])).float()
    for k in range(len(chosen)):
        if rng.uniform() < DROP_HINT:
            without_hint(evidence[k])
        elif rng.uniform() < WRONG_HINT:
            evidence[k, HINT_CHANNELS.start] += evidence[k, HINT_CHANNELS.start + 1] * rng.normal(0, HINT_OFF)
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


def train(samples: Samples, network: DepthNetwork, steps: int, seed: int, out: Path) -> DepthNetwork:
    """Train ``network``, and return the average of its last weights, which ``out`` has every so many steps as well."""
    rng = np.random.default_rng(seed)
    network = network.train().requires_grad_(True).to(memory_format=torch.channels_last)
    average = copy.deepcopy(network)
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    order, losses = np.zeros(0, np.int64), list[float]()
    for step in range(1, steps + 1):
        if len(order) < BATCH:
            order = rng.permutation(len(samples.truth))
        chosen, order = order[:BATCH], order[BATCH:]
        optimiser.param_groups[0]["lr"] = RATE * min(step / WARM_UP, 1.0, (steps + 1 - step) / (FALL * steps))
        evidence, truth = batch(samples, chosen, rng)
        with torch.autocast("cpu", torch.bfloat16):
            found = network(evidence)
        loss = loss_of(found, truth)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), MOST_GRADIENT)
        optimiser.step()
        keep = min(AVERAGE, step / (step + 10))
        with torch.no_grad():
            for mean, p in zip(average.parameters(), network.parameters(), strict=True):
                mean.lerp_(p, 1 - keep)
        losses.append(float(loss.detach()))
        if step % SAY_EVERY == 0:
            spent = time.process_time()
            print(f"step {step}: loss {np.mean(losses[-SAY_EVERY:]):.3f}, {spent:.0f} s of CPU time", flush=True)
            save_network(average, out)
    return average.eval()


def evaluate(network: DepthNetwork, samples: Samples) -> float:
    """Print the errors on held-out walks; returns the spread's factor so that 68 % of the errors are within it."""
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
    parser.add_argument("--walks", type=int, default=106, help="walks to make samples of; 20 MB each")
    parser.add_argument("--held-out", type=int, default=6, help="walks of rooms that only figures are made of")
    parser.add_argument("--steps", type=int, default=5_000, help="of 4 samples; 0.08 s of CPU time each")
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    make(given.samples / "train", FIRST_SEED, given.walks)
    make(given.samples / "held_out", FIRST_HELD_OUT, given.held_out)
    torch.manual_seed(given.seed)
    network = DepthNetwork() if given.start is None else load_network(given.start)
    network = train(load(given.samples / "train"), network, given.steps, given.seed, given.out)
    factor = evaluate(network, load(given.samples / "held_out"))
    assert network.head.bias is not None
    with torch.no_grad():
        network.head.bias[-1] += float(np.log(factor))
    save_network(network, given.out)


if __name__ == "__main__":
    main()
