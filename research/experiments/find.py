"""Are the first answers to generated phrases right? Homes of ``scenes.days``, one visit, true labels.

    python -m research.experiments.find --split test          # --own: labels of S-Ray instead of the true ones
    python -m research.experiments.find --split test --mcp    # 20 things in 3 homes, by the MCP SDK's own client

A phrase has a class or a synonym and one to three of: colour, size, room, a relation; at most half of the things of its
class fit it. What is said of a thing is true, false, or unclear by the scene itself: colours by hue and value of the
materials, sizes and relations by the true boxes, rooms by their template. An answer is right where all is true of the
thing there, and left out where something is unclear. Things that too few frames saw do not count."""

from __future__ import annotations

import argparse
import colorsys
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
from mcp import Client, StdioServerParameters, stdio_client

from research.experiments.days import (
    FRAME_NS,
    FRAMES,
    LEAST_PIXELS,
    OWN_WIDTH,
    SPLITS,
    VISIT_NS,
    WIDTH,
    Labelled,
    OwnLabels,
    Thing,
    near,
    things_of,
)
from research.scenes.config import NoiseConfig
from research.scenes.days import make_home, visit
from research.suites.config import camera_of_width
from semantic_mapper.labels import ROOMS
from semantic_mapper.queries.find import FoundObject, find, open_objects
from semantic_mapper.queries.instances import OrientedBox
from semantic_mapper.queries.objects import remember

HUES = {"red": (-15, 10), "orange": (20, 38), "yellow": (48, 65), "green": (85, 155), "blue": (205, 250)}
HUES |= {"turquoise": (170, 192), "purple": (262, 295), "pink": (305, 340)}
NOUNS = {"sofa": ("sofa", "couch"), "refrigerator": ("refrigerator", "fridge"), "picture": ("picture", "painting")}
NOUNS |= {"cabinet": ("cabinet", "cupboard"), "bookshelf": ("bookshelf", "bookcase"), "otherprop": ("thing", "object")}
NOUNS |= {"otherfurniture": ("other furniture",), "curtain": ("curtain", "drapes")}
TOPS = {"table", "desk", "counter", "cabinet", "otherfurniture"}
Judged = bool | None  # None = unclear
Condition = tuple[str, str, Callable[[Thing], Judged]]  # words before the noun, behind it, and whether it is so


def make(seed: int, own: bool, path: Path) -> None:
    """Map a home and write its map and its things."""
    home, mapper = make_home(seed), OwnLabels() if own else Labelled(ROOMS)
    counts = np.zeros((len(home.rooms), 1 << 16), np.int64)
    views = visit(home, seed, FRAMES, camera_of_width(OWN_WIDTH if own else WIDTH), NoiseConfig())
    for number, (room, view) in enumerate(views):
        mapper.add(replace(view.frame, stamp_ns=20_000 * VISIT_NS + number * FRAME_NS, seq=number))
        counts[room] += np.bincount(view.rendered.instance.ravel(), minlength=1 << 16) >= LEAST_PIXELS
    assert remember(mapper.voxel_map) is not None
    path.with_suffix(".json").write_text(json.dumps(list(things_of(home, counts))))
    mapper.voxel_map.save(path)


def color_of(thing: Thing) -> str | None:
    """Name of its colour, where nobody would give it another."""
    if thing.rgb is None:
        return None
    hue, saturation, value = colorsys.rgb_to_hsv(*thing.rgb)
    if saturation < 0.1:
        grey = (("white", 0.85, 1.1), ("gray", 0.4, 0.65), ("black", -1, 0.2))
        return next((name for name, least, most in grey if least <= value < most), None)
    degrees = (hue * 360 + 20) % 360 - 20
    if saturation > 0.45 and 0.25 < value < 0.5 and 15 < degrees < 40:
        return "brown"
    return next((name for name, (a, b) in HUES.items() if min(saturation, value) > 0.4 and a <= degrees < b), None)


def conditions(thing: Thing, things: Sequence[Thing], rng: np.random.Generator) -> list[Condition]:
    """What can be said of a thing."""
    room = "living room" if thing.room == "living" else thing.room
    found: list[Condition] = [("", f"in the {room}", lambda o: o.room == thing.room)]
    if color := color_of(thing):
        found.append((color, "", lambda o: None if (c := color_of(o)) is None else c == color))
    of_class = [np.subtract(o.high, o.low) for o in things if o.name == thing.name]
    lengths: tuple[tuple[str, Callable[[Any], Any]], ...] = (("large", np.linalg.norm), ("tall", lambda size: size[2]))
    for word, length in lengths if len(of_class) > 2 else ():
        median = float(np.median([length(size) for size in of_class]))

        def large(o: Thing, length: Callable[[Any], Any] = length, median: float = median) -> Judged:
            ratio = float(length(np.subtract(o.high, o.low))) / median
            return True if ratio > 1.35 else False if ratio < 1.05 else None

        if large(thing):
            found.append((word, "", large))
    for other in things:
        for relation, judge in (("near", _near), ("on", _on)):
            if other is not thing and other.name != "otherprop" and judge(thing, other):
                same = [o for o in things if o.name == other.name]

                def related(o: Thing, judge: Any = judge, same: Sequence[Thing] = same) -> Judged:
                    said = [judge(o, b) for b in same if b is not o]
                    return True if True in said else None if None in said else False

                noun = str(rng.choice(NOUNS.get(other.name, (other.name,))))
                found.append(("", f"{relation} the {noun}", related))
    return found


def _near(a: Thing, b: Thing) -> Judged:
    apart = np.maximum(np.maximum(np.subtract(a.low, b.high), np.subtract(b.low, a.high)), 0)
    distance = float(np.linalg.norm(apart))
    return True if distance < 0.5 else False if distance > 1.0 or a.room != b.room else None


def _on(a: Thing, b: Thing) -> Judged:
    middle = np.add(a.low, a.high)[:2] / 2
    aside = float(np.maximum(np.maximum(b.low[:2] - middle, middle - b.high[:2]), 0).max())
    if b.name in TOPS and aside == 0 and abs(a.low[2] - b.high[2]) < 0.03:
        return True
    return False if aside > 0.15 or not b.low[2] + 0.1 < a.low[2] < b.high[2] + 0.3 else None


def phrases(things: Sequence[Thing], count: int, rng: np.random.Generator) -> Iterator[tuple[str, str, list[Judged]]]:
    """Phrases, their nouns, and of each whether it is true of each thing."""
    said = set[str]()
    while len(said) < count:
        name = str(rng.choice(sorted({t.name for t in things})))  # classes of few things as often as of many
        thing = things[int(rng.choice([n for n, t in enumerate(things) if t.name == name]))]
        options = conditions(thing, things, rng)
        chosen = [options[int(n)] for n in rng.permutation(len(options))[: int(rng.integers(1, 4))]]
        noun = str(rng.choice(NOUNS.get(name, (name,))))
        before, behind = sorted({c[0] for c in chosen} - {""}, reverse=True), sorted({c[1] for c in chosen} - {""})
        text, fits = " ".join([*before, noun, *behind]), [name in (t.name, "otherprop") for t in things]
        holds = [[c[2](t) for c in chosen] if fit else [False] for t, fit in zip(things, fits, strict=True)]
        truth: list[Judged] = [False if False in h else None if None in h else True for h in holds]
        if text not in said and 0 < truth.count(True) <= sum(fits) / 2:
            said.add(text)
            yield text, noun, truth


def rank(answers: Sequence[FoundObject], things: Sequence[Thing], truth: Sequence[Judged]) -> int:
    """Place of the first right answer, from 1; 0 = none."""
    place = 0
    for answer in answers:
        o = answer.object
        middles = np.array([np.add(t.low, t.high) / 2 for t in things])
        order = np.linalg.norm(middles - o.box.center, axis=1).argsort()
        there = (n for n in order if things[n].name == o.class_name and near(o.box, (things[n].low, things[n].high)))
        judged = truth[n] if (n := next(there, None)) is not None else False
        place += judged is not None
        if judged:
            return place
    return 0


def ask_agent(path: Path, texts: Sequence[str]) -> list[list[Any]]:
    """What ``semantic-mapper mcp`` answers to phrases, as ``find`` would."""
    program = Path(sys.executable).with_name("semantic-mapper")

    async def ask() -> list[list[Any]]:
        server, found = StdioServerParameters(command=str(program), args=["mcp", str(path)]), list[list[Any]]()
        async with Client(stdio_client(server)) as client:
            for text in texts:
                content: Any = (await client.call_tool("find", {"phrase": text})).content[0]
                found.append([_object(**answer) for answer in json.loads(content.text)["answers"]])
        return found

    return anyio.run(ask)


def _object(box: dict[str, Any], **said: Any) -> Any:
    places = OrientedBox(*(np.array(box[name]) for name in ("center", "size", "R_world_box")))
    return SimpleNamespace(object=SimpleNamespace(class_name=said["class"], box=places))


def main() -> None:
    """Map what is missing, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=tuple(SPLITS), default="tune")
    parser.add_argument("--homes", type=int, default=20)
    parser.add_argument("--phrases", type=int, default=200)
    parser.add_argument("--own", action="store_true", help="labels of S-Ray")
    parser.add_argument("--out", type=Path, default=Path("runs/find"), help="maps; made where they are missing")
    parser.add_argument("--mcp", action="store_true", help="ask for 20 things in 3 homes, as an agent does")
    parser.add_argument("--say", action="store_true", help="name each phrase whose first answer is wrong")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    ranks, alone, seeds = list[int](), list[int](), SPLITS[arguments.split][: 3 if arguments.mcp else arguments.homes]
    for seed in seeds:
        path = arguments.out / f"{seed}{'-own' if arguments.own else ''}.npz"
        if not path.exists():
            make(seed, arguments.own, path)
        things = [Thing(*row) for row in json.loads(path.with_suffix(".json").read_text())]
        if arguments.mcp:
            asked = list(phrases(things, 7 if seed < seeds[2] else 6, np.random.default_rng((49, seed))))
            answers = ask_agent(path, [text for text, _, _ in asked])
            ranks += [rank(found, things, truth) for found, (_, _, truth) in zip(answers, asked, strict=True)]
            print(seed, list(zip([text for text, _, _ in asked], ranks[-len(asked) :], strict=True)), flush=True)
            continue
        snapshot, objects = open_objects(path)
        for text, noun, truth in phrases(
            things, -(-arguments.phrases // len(seeds)), np.random.default_rng((79, seed))
        ):
            answers = find(text, snapshot, objects, limit=12)
            ranks.append(rank(answers, things, truth))
            alone.append(rank(find(noun, snapshot, objects, limit=12), things, truth))
            if arguments.say and ranks[-1] != 1:
                got = [f"{a.object.class_name} {a.object.box.center.round(1)} {dict(a.parts)}" for a in answers[:1]]
                print(f"{seed} {ranks[-1]} {text}: got {got}", flush=True)
    for what, found in (("phrase", ranks), *([("noun alone", alone)] if alone else [])):
        first, five = (sum(0 < r <= most for r in found) / len(found) for most in (1, 5))
        print(f"{len(found)} x {what}: first answer right {first:.0%}, one of the first five {five:.0%}")


if __name__ == "__main__":
    main()
