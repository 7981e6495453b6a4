#!/bin/sh
# Guess: warpFrame of OpenCV 5 puts each pixel into the pixel nearest to where it moves; by the identity nothing moves.
# Found: it cuts the fraction off. A shift of 0.9 pixels moves nothing, one of -0.1 moves the whole picture by one: half
#        a pixel off on average. The identity suffers where the way there and back ends a hair below a whole number:
#        with f 300 and the centre at (159.5, 119.5) 9 % of the pixels stay and 37 % take their right neighbour's value;
#        with float64 depth of 3.3 m and the centre at (160, 120) 17 % become holes. registerDepth rounds.
# Seen:  opencv-contrib-python-headless 5.0.0.93, Python 3.11, Linux x86-64.
# Who:   users who check a pose or an odometry by the picture that warpFrame predicts.
# What to do: take registerDepth for depth; project and round colours without it.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import cv2
import numpy as np

SIZE = 240, 320
IMAGE = np.random.default_rng(0).integers(0, 256, SIZE, np.uint8)


def warp(centre, depth, shift_px=0.0):
    camera, moved = np.array([[300, 0, centre[0]], [0, 300, centre[1]], [0, 0, 1.0]]), np.eye(4)
    moved[0, 3] = shift_px / 300 * float(depth)
    _, image, mask = cv2.warpFrame(np.full(SIZE, depth), IMAGE, None, moved, camera)
    return image, mask > 0


def moved_px(shift_px):
    image, known = warp((160, 120), np.float32(2), shift_px)
    return max(range(-2, 3), key=lambda px: np.mean((np.roll(IMAGE, px, 1) == image) & known))


moves = {shift: moved_px(shift) for shift in (0.4, 0.9, -0.1, -0.6)}
image, known = warp((159.5, 119.5), np.float32(2))
stay, from_right = np.mean((image == IMAGE) & known), np.mean((image[:, :-1] == IMAGE[:, 1:]) & known[:, :-1])
holes = 1 - warp((160, 120), np.float64(3.3))[1].mean()
depth = (1000 + 5 * np.arange(SIZE[1])[None].repeat(SIZE[0], 0)).astype(np.uint16)
K = np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]], np.float32)
registered = cv2.registerDepth(K, K, np.zeros(5, np.float32), np.eye(4, dtype=np.float32), depth, SIZE[::-1])
print(
    f"shifts {moves}; identity: {stay:.0%} stay, {from_right:.0%} from the right, {holes:.0%} holes; "
    f"registerDepth changes {np.count_nonzero(registered != depth)} pixels"
)
sys.exit(
    moves != {0.4: 0, 0.9: 0, -0.1: -1, -0.6: -1}
    or stay > 0.5
    or from_right < 0.1
    or holes < 0.05
    or bool((registered != depth).any())
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q opencv-contrib-python-headless==5.0.0.93 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
