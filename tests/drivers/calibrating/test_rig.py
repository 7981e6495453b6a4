"""Where the cameras of a rig sit is found again from boards that several of them see."""

import dataclasses

import numpy as np
import pytest

from semantic_mapper.drivers.calibrating import rig
from semantic_mapper.drivers.calibrating.rig import calibrate_rig, solve
from semantic_mapper.drivers.calibrating.views import (
    MAX_VIEWS,
    BoardView,
    CalibrationConfig,
    ViewGatherer,
    simultaneous,
)
from semantic_mapper.errors import CameraError
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import Float64
from tests.drivers.poses.images import rigid

from .boards import BOARD, LENS, image, made_up, shown, views

CONFIG = CalibrationConfig()
RIG = {
    "left": np.eye(4),
    "right": rigid((0.02, -0.06, 0.01), (0.06, 0.004, -0.006)),
    "back": rigid((0, 0.3, 0), (-0.1, 0, 0)),
}


def shows(names: tuple[str, ...], count: int, noise_px: float = 0.15) -> list[dict[str, BoardView]]:
    """Boards before some cameras of the rig."""
    rng = np.random.default_rng(1)
    found = []
    for stamp, T_left_board in enumerate(views(count, aside=0.6)):
        sights = {n: made_up(invert_pose(RIG[n]) @ T_left_board, stamp, noise_px, rng) for n in names}
        found.append({n: view for n, view in sights.items() if view is not None})
    return [group for group in found if len(group) > 1]


def check_close(found: Float64, truth: Float64, metres: float = 0.001, degrees: float = 0.2) -> None:
    difference = invert_pose(truth) @ found
    assert np.linalg.norm(difference[:3, 3]) < metres
    assert np.degrees(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))) < degrees


def test_a_rig_is_found_to_a_millimetre_and_says_how_well() -> None:
    lenses = {"left": LENS, "right": LENS}
    found, rms_px = calibrate_rig(lenses, shows(("left", "right"), 24), CONFIG)
    check_close(found["right"].T_rig_camera, RIG["right"], 0.0005, 0.05)
    np.testing.assert_array_equal(found["left"].T_rig_camera, np.eye(4))
    assert rms_px == pytest.approx(0.15 * np.sqrt(2), rel=0.15)
    assert found["left"].position_sigma_m == 0 and found["right"].moments >= 12
    errors, sigmas = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        groups = [
            {n: dataclasses.replace(v, pixels=v.pixels + rng.normal(0, 0.4, v.pixels.shape)) for n, v in g.items()}
            for g in shows(("left", "right"), 24, 0.0)
        ]
        again = calibrate_rig(lenses, groups, CONFIG)[0]["right"]
        errors.append(np.sqrt(((again.T_rig_camera - RIG["right"])[:3, 3] ** 2).mean()))
        sigmas.append(again.position_sigma_m)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas) < 2.0


def test_cameras_that_never_look_together_are_joined_through_a_third() -> None:
    groups = shows(("left", "right"), 24) + shows(("left", "back"), 24)
    lenses = {"right": LENS, "left": LENS, "back": LENS}
    found, _ = calibrate_rig(lenses, groups, CONFIG)
    check_close(found["back"].T_rig_camera, invert_pose(RIG["right"]) @ RIG["back"])


def test_too_few_moments_in_common_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    groups = shows(("left", "right"), 24)
    with pytest.raises(CameraError, match="camera 'right': saw the board at only 5 moments"):
        calibrate_rig({"left": LENS, "right": LENS}, groups[:5], CONFIG)
    with pytest.raises(CameraError, match="camera 'back': saw the board at only 0 moments"):
        calibrate_rig({"left": LENS, "right": LENS, "back": LENS}, groups, CONFIG)
    monkeypatch.setattr(rig, "MAX_POSITION_SIGMA_M", 1e-7)
    with pytest.raises(CameraError, match="place on the rig is known to"):
        calibrate_rig({"left": LENS, "right": LENS}, groups, CONFIG)


def test_views_count_as_simultaneous_within_a_time() -> None:
    points = np.zeros((8, 3))

    def at(ms: int) -> BoardView:
        return BoardView(str(ms), ms * 1_000_000, points, points[:, :2])

    own = {"a": [at(0), at(100), at(200)], "b": [at(15), at(130), at(201)], "c": [at(19)]}
    groups = simultaneous(own)
    assert [{n: v.name for n, v in g.items()} for g in groups] == [
        {"a": "0", "b": "15", "c": "19"},
        {"a": "200", "b": "201"},
    ]
    many = {name: [at(1000 * i) for i in range(200)] for name in "ab"}
    thin = simultaneous(many)
    assert len(thin) == MAX_VIEWS and thin[0]["a"].name == "0" and thin[-1]["b"].name == "199000"


def test_pictures_of_two_cameras_give_lenses_and_rig_at_once() -> None:
    gathered = {name: ViewGatherer(BOARD, CONFIG, stream=False) for name in ("left", "right")}
    other = dataclasses.replace(LENS, fx=430.0, fy=431.0, distortion=(-0.15, 0.03, 0.0, 0.0, 0.0))
    for seq, (T_left_board, picture) in enumerate(shown()):
        gathered["left"].take(dataclasses.replace(picture, camera_id="left"))
        gathered["right"].take(image(seq, invert_pose(RIG["right"]) @ T_left_board, other, "right"))
    config = CalibrationConfig(min_views=8)
    found = solve(gathered, (), config, rig=True)
    assert abs(found.cameras["left"].intrinsics.fx / LENS.fx - 1) < 0.005
    assert abs(found.cameras["right"].intrinsics.fx / other.fx - 1) < 0.005
    check_close(found.rig["right"].T_rig_camera, RIG["right"])
    gathered["left"].intrinsics, gathered["right"].intrinsics = LENS, other
    kept = solve(gathered, {"left", "right"}, config, rig=True)
    assert not kept.cameras["left"].sigmas
    check_close(kept.rig["right"].T_rig_camera, RIG["right"], 0.0003, 0.03)
