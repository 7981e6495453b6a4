"""Depth of the left camera of a calibrated pair: both images rectified, matched by semi-global matching (OpenCV).

A match has to be found from the right image as well, and patches of a few pixels that disagree with all around them are
left out: no depth is better than a guess, since a map has other views of the place.
"""

import cv2
import numpy as np

from semantic_mapper.drivers.calibration import StereoCalibration
from semantic_mapper.drivers.lens import clear_view
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import Float32, UInt8

BLOCK = 5  # pixels a side that are compared
STEP = 16  # disparities are searched in multiples of it
SUBPIXEL = 16.0  # steps of a disparity
LEFT_RIGHT_PX = 1  # so far the match found from the right image may be off
UNIQUE_PERCENT = 10  # so much better than the second best match
SPECKLE_PIXELS = 80  # smaller patches are left out, ...
SPECKLE_STEP_PX = 1  # ... whose disparities differ by more from those around
MOST_ASIDE = 0.2  # of the baseline may point up, down or ahead
LEAST_OVERLAP = 0.5  # of the width may be lost to rectification


class StereoDepth:
    """Makes rectified images, at most ``width`` pixels wide, and depth of pairs.

    ``intrinsics`` are those of the rectified left camera, which is turned by a degree or so, so that the image planes
    are one. Raises ConfigError: the cameras are not side by side, or look apart, or the depths are out of reach.
    """

    def __init__(self, pair: StereoCalibration, width: int, min_depth_m: float, max_depth_m: float) -> None:
        left, right = pair.left, pair.right
        width = min(width, left.width)
        size = (width, max(1, round(left.height * width / left.width)))
        offset = pair.T_right_left[:3, 3]
        self.baseline_m = float(np.linalg.norm(offset))
        if self.baseline_m <= 0 or offset[0] >= 0 or np.abs(offset[1:]).max() > MOST_ASIDE * self.baseline_m:
            raise ConfigError(
                f"the right camera is not next to the left one (T_right_left moves {offset.round(4).tolist()} m, its "
                "x must be negative); calibrate again"
            )
        lenses = [(camera_matrix(k), np.array(k.distortion or (0.0,) * 5)) for k in (left, right)]
        R_left, R_right = cv2.stereoRectify(
            *lenses[0], *lenses[1], (left.width, left.height), pair.T_right_left[:3, :3], offset.reshape(3, 1)
        )[:2]
        turned = [(left, np.asarray(R_left, np.float64)), (right, np.asarray(R_right, np.float64))]
        try:  # OpenCV's own view may reach beyond the images
            self.intrinsics = clear_view(turned, *size)
        except FrameError as error:
            raise ConfigError(f"the two cameras have no image in common: {error}; calibrate again") from error
        self._maps = [
            cv2.initUndistortRectifyMap(K, lens, R, camera_matrix(self.intrinsics), size, cv2.CV_16SC2)
            for (K, lens), (_, R) in zip(lenses, turned, strict=True)
        ]
        self.T_left_rectified = np.eye(4)  # from the rectified left camera to the left one
        self.T_left_rectified[:3, :3] = np.asarray(R_left).T
        self._focal_baseline = self.intrinsics.fx * self.baseline_m
        self._depths = (min_depth_m, max_depth_m)
        needed = self._focal_baseline / min_depth_m
        self.disparities = STEP * max(1, int(np.ceil(needed / STEP)))
        if self.disparities > LEAST_OVERLAP * width:
            raise ConfigError(
                f"min_depth_m = {min_depth_m:g} is too near for this pair: surfaces there are {needed:.0f} of {width} "
                f"pixels apart in its images; {self._focal_baseline / (LEAST_OVERLAP * width):.2f} m is possible"
            )
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self.disparities,
            blockSize=BLOCK,
            P1=8 * BLOCK * BLOCK,
            P2=32 * BLOCK * BLOCK,
            disp12MaxDiff=LEFT_RIGHT_PX,
            uniquenessRatio=UNIQUE_PERCENT,
            speckleWindowSize=SPECKLE_PIXELS,
            speckleRange=SPECKLE_STEP_PX,
            mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
        )

    def rectify(self, left: UInt8, right: UInt8) -> tuple[UInt8, UInt8]:
        """Images (H, W, 3) as the lenses give them -> rectified ones, in which a point has the same row in both."""
        images = zip((left, right), self._maps, strict=True)
        first, second = (np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8) for image, maps in images)
        return first, second

    def depth(self, left: UInt8, right: UInt8) -> Float32:
        """Depth (H, W) in metres of the left one of two rectified RGB images; 0 where there is no match."""
        grey = [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8) for image in (left, right)]
        # The matcher gives nothing where its search would leave the image on the left; with a margin it does.
        wide = [cv2.copyMakeBorder(g, 0, 0, self.disparities, 0, cv2.BORDER_REPLICATE) for g in grey]
        found = np.asarray(self._matcher.compute(*wide))[:, self.disparities :]
        disparity = found.astype(np.float32) / np.float32(SUBPIXEL)
        seen_by_both = disparity <= np.arange(disparity.shape[1], dtype=np.float32)
        least, most = (np.float32(self._focal_baseline / depth) for depth in reversed(self._depths))
        good = (disparity >= least) & (disparity <= most) & seen_by_both
        depth_m = np.zeros_like(disparity)
        depth_m[good] = np.float32(self._focal_baseline) / disparity[good]
        return depth_m
