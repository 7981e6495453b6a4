#!/bin/sh
# Guess: a pose graph that gtsam writes with writeG2o and reads with readG2o is the same to about 1e-12.
# Found: each number is written with six significant digits. A pose in UTM (northing 5,300,000 m) comes back to the
#        nearest 10 m, one at 2 km to the nearest centimetre, and rotations to 7e-5 degrees. Steps of 1 m between poses
#        in UTM become steps of 0 and 10 m, while the edges between them keep their length. No warning.
# Seen:  gtsam 4.3.0, Python 3.11, Linux x86-64.
# Who:   users who hand a georeferenced pose graph to another optimizer, or keep it for later.
# What to do: subtract the first place before writing, or keep gtsam.Values by its serialize().
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import gtsam
import numpy as np


def kept(origin_m, path):
    """Errors of place in m, of rotation, and of the steps of 1 m, after writing and reading."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    poses = [
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3 + 0.01 * i), np.add(origin_m, (0.123456 * i, i + 0.654321, 1.5)))
        for i in range(20)
    ]
    for i, pose in enumerate(poses):
        values.insert(i, pose)
        if i:
            graph.add(gtsam.BetweenFactorPose3(i - 1, i, poses[i - 1].between(pose), noise))
    gtsam.writeG2o(graph, values, path)
    _, read = gtsam.readG2o(path, True)
    back = [read.atPose3(i) for i in range(len(poses))]
    places = np.array([pose.translation() for pose in back])
    off = np.abs(places - [pose.translation() for pose in poses]).max()
    turned = max(np.linalg.norm(gtsam.Rot3.Logmap(a.rotation().between(b.rotation()))) for a, b in zip(poses, back))
    steps = np.diff(places[:, 1])
    serialized = gtsam.Values()
    serialized.deserialize(values.serialize())
    exact = max(np.abs(serialized.atPose3(i).matrix() - pose.matrix()).max() for i, pose in enumerate(poses))
    print(
        f"origin {origin_m}: {off:.6f} m, {np.degrees(turned):.1e} deg, steps {steps.min():.3f} to {steps.max():.3f} m; "
        f"by serialize() {exact:.0e}"
    )
    return off, turned, steps, exact


near, far = kept((0, 0, 0), sys.argv[1]), kept((500_000, 5_300_000, 100), sys.argv[1])
middle = kept((0, 2_000, 0), sys.argv[1])
sys.exit(
    not (
        1 < far[0] < 10
        and 1e-3 < middle[0] < 1e-2
        and np.allclose(np.unique(far[2]), (0, 10))
        and 1e-7 < far[1] < 1e-5
        and near[0] < 1e-4
        and far[3] < 1e-9
    )
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q gtsam==4.3.0 numpy==2.4.6
"$work/env/bin/python" "$work/try.py" "$work/graph.g2o"
