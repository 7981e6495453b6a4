"""A live launch for half an hour at 30 frames a second: memory, open files, ages and drops of every process.

Camera (a log in the time of its recording), mapper and recorder run as processes; we listen to what the launcher tells
of them (the status topic, which `semantic-mapper top` shows), and compare what was published with what became of it.

Example: python -m research.experiments.soak --minutes 30 --out runs/soak
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from research.experiments.live_launch import NODES, PATIENCE_S, LiveLaunch
from research.experiments.long_log import write_long_log
from research.plots import Curve, Panel, draw_panels
from semantic_mapper.plots import write_picture
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import NewestSubscriber
from semantic_mapper.types import Float64

HZ = 30.0
MAX_SLOPE_MB_MIN = 1.0
MAX_AGE_PERIODS = 2.0
START_S = 120.0  # of the log beside the soak, for start and end
SAVE_EVERY_S = 30
MAX_POINTS = 400  # of a curve


@dataclass(slots=True)
class Samples:
    """What was seen of one process; times are seconds since the soak began."""

    at_s: list[float] = field(default_factory=list[float])
    rss_mb: list[float] = field(default_factory=list[float])
    files: list[int] = field(default_factory=list[int])
    counters: list[dict[str, int]] = field(default_factory=list[dict[str, int]])
    ages_s: list[dict[str, float]] = field(default_factory=list[dict[str, float]])

    def note(self, at_s: float, status: Status) -> None:
        """One status."""
        if "rss_kb" not in status.counters:  # it has ended
            return
        self.at_s.append(at_s)
        self.rss_mb.append(status.counters["rss_kb"] / 1024)
        self.files.append(status.counters["fds"])
        self.counters.append(dict(status.counters))
        self.ages_s.append(dict(status.ages_s))

    def after(self, warm_s: float) -> slice:
        """Samples after the warm-up."""
        return slice(int(np.searchsorted(self.at_s, warm_s)), None)

    def slope_mb_min(self, warm_s: float) -> float:
        """Of a straight line through the memory after the warm-up."""
        late = self.after(warm_s)
        return float(np.polyfit(np.array(self.at_s[late]) / 60, np.array(self.rss_mb[late]), 1)[0])


def watch(launch: LiveLaunch, minutes: float) -> dict[str, Samples]:
    """Listen until the time is over."""
    launch.listen()
    folder = launch.told.wait("sockets=")[1].split("sockets=")[1].split()[0]
    began = time.monotonic()
    seen: defaultdict[str, Samples] = defaultdict(Samples)
    told = 0
    with NewestSubscriber(f"ipc://{folder}/launch", ("status",)) as subscriber:
        while time.monotonic() - began < 60 * minutes:
            status = subscriber.receive(1.0)
            if isinstance(status, Status):
                seen[status.node].note(time.monotonic() - began, status)
            if time.monotonic() - began > 60 * told:
                mapper = seen["mapper"].counters[-1:] or [{}]
                print(f"minute {told} of {minutes:g}: {mapper[0]}", flush=True)
                told += 1
    return dict(seen)


def frame_ages_s(launch: LiveLaunch) -> list[tuple[float, float]]:
    """Of each mapped frame, when its mapping began, how old it was: from when it was published, as we have heard it."""
    assert launch.camera is not None and launch.mapper is not None
    published = {seq: at for at, seq in launch.camera.numbers("frame")}
    mapped = launch.mapper.numbers("map")
    worked = launch.mapper.worked_s
    return [(at - worked[seq], at - worked[seq] - published[seq]) for at, seq in mapped if seq in published]


def judge(
    seen: dict[str, Samples], ages_s: list[float], published: int, summary: dict[str, Any], warm_s: float
) -> dict[str, Any]:
    """All figures, and whether they are as they should be.

    Args:
        seen: From ``watch``.
        ages_s: From ``frame_ages_s``.
        published: Frames that the camera has sent, as we have heard them.
        summary: Of the mapper, written at the end.
        warm_s: What is left out of slopes at the beginning.
    """
    mapper = seen["mapper"]
    late = mapper.after(warm_s)
    first, last = mapper.counters[late][0], mapper.counters[-1]
    period_s = (mapper.at_s[-1] - mapper.at_s[late][0]) / max(1, last["fused"] - first["fused"])
    processes = {
        name: {
            "rss_mb_first": s.rss_mb[s.after(warm_s)][0],
            "rss_mb_last": s.rss_mb[-1],
            "rss_slope_mb_min": s.slope_mb_min(warm_s),
            "files_first": s.files[s.after(warm_s)][0],
            "files_last": s.files[-1],
            "files_max": max(s.files[s.after(warm_s)]),
        }
        for name, s in seen.items()
    }
    frames = summary["frames"]
    age_p99_s = float(np.percentile(ages_s, 99))
    missing = published - frames["fused"] - frames["refused"]
    return {
        "processes": processes,
        "mapper_period_s": period_s,
        "frame_age_p50_s": float(np.median(ages_s)),
        "frame_age_p99_s": age_p99_s,
        "frames": frames | {"heard": published},
        "missing": missing,
        "restarts": sum(s.counters[-1].get("restarts", 0) for name, s in seen.items() if name in NODES),
        "good": {
            "memory": all(p["rss_slope_mb_min"] < MAX_SLOPE_MB_MIN for p in processes.values()),
            "files": all(p["files_last"] <= p["files_first"] for p in processes.values()),
            "age": age_p99_s < MAX_AGE_PERIODS * period_s,
            "drops": missing == frames["dropped"],
        },
    }


def draw(seen: dict[str, Samples], ages: Sequence[tuple[float, float]], path: Path) -> None:
    """Memory and open files of each process against time, and the ages of frames."""
    minutes = {name: np.array(s.at_s) / 60 for name, s in sorted(seen.items())}
    memory = [Curve(name, _curve(at, seen[name].rss_mb)) for name, at in minutes.items()]
    files = [Curve(name, _curve(at, seen[name].files)) for name, at in minutes.items()]
    age = Curve("p99 of each minute", tuple(ages))
    panels = [
        Panel("resident memory", "MB", "minutes", memory),
        Panel("open files", "files", "minutes", files),
        Panel("age of the frame being mapped", "ms", "minutes", [age]),
    ]
    write_picture(path, draw_panels("Soak", panels))


def _worst_by_minute(ages: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """p99 of the ages of each minute, in milliseconds."""
    minutes: defaultdict[int, list[float]] = defaultdict(list)
    for at_s, age_s in ages:
        minutes[int((at_s - ages[0][0]) / 60)].append(1000 * age_s)
    return [(minute + 0.5, float(np.percentile(found, 99))) for minute, found in sorted(minutes.items())]


def _curve(minutes: Float64, values: Sequence[float]) -> tuple[tuple[float, float], ...]:
    step = max(1, len(values) // MAX_POINTS)
    return tuple((float(m), float(v)) for m, v in zip(minutes[::step], values[::step], strict=True))


def markdown(report: dict[str, Any]) -> str:
    """For people."""
    rows = [
        "| process | MB after warm-up | MB at the end | MB/min | open files: first, last, most |",
        "|---|---|---|---|---|",
    ]
    for name, p in sorted(report["processes"].items()):
        rows.append(
            f"| {name} | {p['rss_mb_first']:.0f} | {p['rss_mb_last']:.0f} | {p['rss_slope_mb_min']:+.2f} | "
            f"{p['files_first']}, {p['files_last']}, {p['files_max']} |"
        )
    f = report["frames"]
    rows += [
        "",
        f"Mapper: a frame every {1000 * report['mapper_period_s']:.0f} ms; age of the frame being mapped p50 "
        f"{1000 * report['frame_age_p50_s']:.0f} ms, p99 {1000 * report['frame_age_p99_s']:.0f} ms. Frames: "
        f"{f['heard']} published, {f['fused']} mapped, {f['refused']} refused, {f['dropped']} counted as dropped; "
        f"{report['missing']} are missing. Restarts: {report['restarts']}.",
    ]
    return "\n".join(rows)


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--warm-up", type=float, default=3.0, help="minutes that slopes leave out")
    parser.add_argument("--log", type=Path, help="of 30 frames a second, numbered from 0; made where it is not given")
    parser.add_argument("--set", action="append", default=[], metavar="SETTING", help="as of `semantic-mapper up`")
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), help="OUT.json, OUT.md and OUT.png are written")
    arguments = parser.parse_args()
    before = os.getloadavg()
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        seconds = 60 * arguments.minutes + START_S
        log = arguments.log or write_long_log(Path(name) / "long.mcap", seconds, HZ)
        settings = (f"camera.log={log.absolute()}", f"mapper.save_every_s={SAVE_EVERY_S}", *arguments.set)
        with LiveLaunch(settings, Path(name) / "up") as launch:
            seen = watch(launch, arguments.minutes)
            launch.process.send_signal(signal.SIGINT)
            if ended := launch.process.wait(PATIENCE_S):  # what came of it is drawn all the same
                print(f"the launch ended with {ended}:\n" + "\n".join(launch.told.all("(.*)")[-30:]))
            assert launch.camera is not None
            published = launch.camera.numbers("frame")[-1][1] + 1  # the log's first frame is number 0
            ages = frame_ages_s(launch)
        summary = json.loads((Path(name) / "up" / "summary.json").read_text())
    report = judge(seen, [age for _, age in ages], published, summary, 60 * arguments.warm_up)
    report["good"]["end"] = ended == 0
    report["about"] = {
        "minutes": arguments.minutes,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Linux {platform.release()}",
        "load before, after": [before, os.getloadavg()],
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.with_suffix(".json").write_text(json.dumps(report, indent=1), encoding="utf-8")
    arguments.out.with_suffix(".md").write_text(markdown(report) + "\n", encoding="utf-8")
    draw(seen, _worst_by_minute(ages), arguments.out.with_suffix(".png"))
    print(markdown(report))
    if not all(report["good"].values()):
        raise SystemExit(f"not as it should be: {report['good']}")


if __name__ == "__main__":
    main()
