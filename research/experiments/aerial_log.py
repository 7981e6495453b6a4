"""A flight over a town of AERIAL as a log without depth: labels on a few views to learn from, and on those to score.

python -m research.experiments.aerial_log flight.mcap --town 100000
semantic-mapper finetune flight.mcap --kind irt --frames NUMBERS --out flight.safetensors
semantic-mapper eval flight.mcap --weights flight.safetensors
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import DAY, AerialConfig, Episode, scored_views, training_frames
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo


def main() -> None:
    """Write the log; prints which frames to learn from."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--town", type=int, default=100_000)
    given = parser.parse_args()
    config, episode = AerialConfig(), Episode(given.town, 0)
    taught = training_frames(config, episode)
    scored = [view.frame for view in scored_views(config, episode, DAY)]
    frames = sorted((*taught, *scored), key=lambda frame: frame.seq)
    learned = {frame.seq for frame in taught if frame.label is not None}
    camera = frames[0].camera_id
    info = StreamInfo(source="aerial", cameras={camera: frames[0].intrinsics}, label_set=AERIAL_SUITE.label_set)
    with LogWriter(given.log, info) as writer:
        for frame in frames:
            writer.write_frame(replace(frame, depth_m=None))
    numbers = ",".join(str(n) for n, frame in enumerate(frames) if frame.seq in learned)
    print(f"{given.log}: {len(frames)} frames; learn from --frames {numbers}")


if __name__ == "__main__":
    main()
