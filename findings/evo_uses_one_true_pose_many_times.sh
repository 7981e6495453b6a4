#!/bin/sh
# Guess: evo's associate_trajectories pairs each pose of either trajectory at most once, as associate.py of the TUM
#        tools does, so that an error is counted once for each pair of neighbours in time.
# Found: only the poses of the trajectory with fewer poses are used once. An estimate of 1 s at 200 Hz has fewer poses
#        than a truth of 60 s at 10 Hz: each true pose is used up to 4 times, 40 pairs for 11 true poses. A flawless
#        estimate at 1 m/s whose stamps are 2.5 ms from the truth's has an APE of 2.5 mm when it is 60 s long, and of
#        5.6 mm for one second of it, from pairs up to 7.5 ms apart.
# Seen:  evo 1.38.1, Python 3.11, Linux x86-64.
# Who:   users who score a short piece, or the part up to where the tracking was lost, against a long truth.
# What to do: cut the truth to the estimate's time first (reduce_to_time_range), or give a smaller max_diff.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D


def flawless(begin_s, end_s, step_s):
    times = np.arange(round((end_s - begin_s) / step_s)) * step_s + begin_s
    places = np.column_stack((times, np.zeros_like(times), np.zeros_like(times)))  # 1 m/s along x
    return PoseTrajectory3D(
        positions_xyz=places, orientations_quat_wxyz=np.tile((1.0, 0, 0, 0), (len(times), 1)), timestamps=times
    )


def score(truth, estimate):
    a, b = sync.associate_trajectories(truth, estimate)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((a, b))
    return a.num_poses, len(np.unique(a.timestamps)), round(error.get_statistic(metrics.StatisticsType.rmse), 4)


short, long = flawless(10.0025, 11.0025, 0.005), flawless(0.0025, 60.0025, 0.005)
cut = flawless(0, 60, 0.1)
cut.reduce_to_time_range(9.99, 11.01)
found = {
    "1 s": score(flawless(0, 60, 0.1), short),
    "60 s": score(flawless(0, 60, 0.1), long),
    "1 s, truth cut": score(cut, short),
}
print("pairs, true poses among them, APE in m:", found)
expected = {"1 s": (40, 11, 0.0056), "60 s": (600, 600, 0.0025), "1 s, truth cut": (11, 11, 0.0025)}
sys.exit(found != expected)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q evo==1.38.1 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
