"""Cameras that circle an axis: spirals become circles, against made-up truth, and what cannot be is told."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from circular_ring import CAMERA, RADIUS, RingSample, drifted, ring_sample
from scipy.spatial.transform import Rotation

from toolkit.errors import Cancelled, CapabilityError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.circle import CircleErrors, circle_errors, fit_circle
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.circular import close_circle
from toolkit.poses.circular_result import CircularResult
from toolkit.poses.circular_settings import CircularSettings
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.scene import Scene

SHAKE = {"shake": 0.002, "orientation_shake": 0.05}


def sample(frames: int = 90, **values: object) -> RingSample:
    return ring_sample(frames, points_a_blade=4, **{**SHAKE, **values})


def run(scene: Scene, **values: object) -> CircularResult:
    return close_circle(scene, CircularSettings(**values))


def gap_against_truth(found: Scene, truth: Scene) -> float:
    """How far the last camera is from where it truly is, seen from the first, as a part of the circumference."""
    to_truth = trajectory_errors(found, truth).reference_from_estimate
    ends = to_truth.apply(found.centres([found.registered[0], found.registered[-1]]))
    true = truth.centres([truth.frame(found.registered[0].name), truth.frame(found.registered[-1].name)])
    return float(np.linalg.norm((ends[1] - ends[0]) - (true[1] - true[0]))) / (2 * np.pi * RADIUS)


def assert_as_asked(errors: CircleErrors) -> None:
    """Acceptance: positions within 0.5 % of the radius, orientations and angles within 0.3 degrees, every frame."""
    assert errors.position.max() < 0.005
    assert errors.rotation_deg.max() < 0.3
    assert np.abs(errors.angle_deg).max() < 0.3


def errors_of_mount(found: Scene, truth: Scene) -> float:
    """Degrees by which the mean camera is turned in its own axes after the alignment."""
    to_truth = trajectory_errors(found, truth).reference_from_estimate
    off = []
    for mine, true in zip(found.registered, truth.registered, strict=True):
        assert mine.cam_from_world is not None
        assert true.cam_from_world is not None
        turned = to_truth.apply_to_pose(mine.cam_from_world).rotation @ true.cam_from_world.rotation.T
        off.append(Rotation.from_matrix(turned).as_rotvec(degrees=True))
    return float(np.linalg.norm(np.mean(off, axis=0)))


def test_a_spiral_of_300_degrees_closes_with_matches_across_the_seam() -> None:
    made = sample()
    spiral = drifted(made)
    before = circle_errors(spiral, made.scene)
    assert before.position.max() > 0.3
    result = run(spiral, full_turn=True)
    assert_as_asked(circle_errors(result.scene, made.scene))
    assert gap_against_truth(result.scene, made.scene) < 0.001
    # What ends the turn is a step that nobody measured, of 4 degrees that vary by a tenth: 0.1 % of 360.
    assert result.closure_gap is not None
    assert result.closure_gap < 0.002
    assert result.start_angles[-1] == pytest.approx(300 / 360 * made.angles[-1], rel=0.02)
    # The pixels had 0.4 px; 90 frames and some points take a part of it.
    assert result.noise == pytest.approx(0.4, rel=0.15)
    # Shake of 0.2 % was put in, and is allowed by the slacks.
    assert result.slack_rms["axial"] == pytest.approx(0.002, rel=0.3)
    assert result.slack_rms["radial"] == pytest.approx(0.002, rel=0.3)
    assert result.remarks == ()
    # The lens was 6 % too long and without distortion at the start.
    camera = result.cameras[0]
    assert camera.sigma is not None
    off = np.abs(np.subtract(camera.after, CAMERA.params))
    assert (off < 5 * np.array(camera.sigma)).all()
    assert off[0] < 2.0
    # The orientation that all frames share is off by what it says of itself.
    assert camera.mount_sigma is not None
    assert errors_of_mount(result.scene, made.scene) < 4 * camera.mount_sigma
    # The noise of these pixels is independent, so all orientations are as far off as is said, within a factor.
    off = circle_errors(result.scene, made.scene).rotation_deg
    assert result.orientation_sigma is not None
    assert 0.3 < float(np.sqrt(np.mean(off**2))) / result.orientation_sigma < 3


def test_a_known_turn_closes_it_with_those_matches_withheld() -> None:
    made = sample(seam=False)
    result = run(drifted(made), full_turn=True)
    assert result.seam_points == 0
    assert_as_asked(circle_errors(result.scene, made.scene))
    assert gap_against_truth(result.scene, made.scene) < 0.01


@pytest.mark.parametrize("turn", [290 / 360, 400 / 360])
def test_matches_across_the_seam_tell_the_turn_by_themselves(turn: float) -> None:
    made = sample()
    result = run(drifted(made, turn=turn))
    assert result.seam_points > 50
    assert result.closure_gap is None
    assert_as_asked(circle_errors(result.scene, made.scene))
    assert gap_against_truth(result.scene, made.scene) < 0.001


def test_an_arc_of_290_degrees_becomes_the_98_that_are_known() -> None:
    made = sample(turn=98.0)
    result = run(drifted(made, turn=290 / 98), full_turn=True, turn_angle=98.0)
    # Points that leave the picture at its edge and come back may look like it, far fewer than it takes.
    assert result.seam_points < 10
    # A step of about 1.1 degrees that nobody measured ends the turn.
    assert result.arc_degrees == pytest.approx(made.angles[-1], abs=0.3)
    errors = circle_errors(result.scene, made.scene)
    assert errors.position.max() < 0.005
    assert np.abs(errors.angle_deg).max() < 0.3
    # An open arc leaves the principal point open by some pixels, each 0.22 degrees of every camera's orientation.
    assert errors.rotation_deg.max() < 0.6


def test_two_frames_may_tell_the_turn() -> None:
    made = sample(turn=240.0, seam=False)
    known = float(made.angles[70] - made.angles[10])
    result = run(drifted(made), full_turn=True, turn_first=10, turn_last=70, turn_angle=known, turn_sigma=0.01)
    assert result.angles[70] - result.angles[10] == pytest.approx(known, abs=0.05)
    assert_as_asked(circle_errors(result.scene, made.scene))


def test_the_hard_circle_fits_where_nothing_shakes() -> None:
    made = sample(shake=0.0, orientation_shake=0.0)
    result = run(drifted(made), full_turn=True, mode="hard")
    assert_as_asked(circle_errors(result.scene, made.scene))
    assert result.slack_rms == {"axial": 0.0, "radial": 0.0, "orientation_deg": 0.0}
    fit = fit_circle(result.scene.centres())
    # Centres are exactly on the circle, but for rounding and the tolerance of the fit.
    assert max(fit.radius_spread, fit.out_of_plane_rms) < 1e-7


def test_the_hard_circle_stalls_on_shake_and_says_so() -> None:
    made = sample()
    result = run(made.scene, full_turn=True, mode="hard")
    assert result.noise > 1.5 * result.start_noise
    assert any("needs the soft mode" in remark for remark in result.remarks)


def test_wrong_observations_do_no_harm() -> None:
    made = sample(wrong=0.05)
    result = run(drifted(made), full_turn=True)
    assert_as_asked(circle_errors(result.scene, made.scene))
    assert made.scene.points is not None
    assert made.scene.points.tracks is not None
    assert result.observations_removed > 0.03 * len(made.scene.points.tracks.point)


def test_intrinsics_that_are_kept_stay() -> None:
    made = sample()
    kept = {"refine_focal": False, "refine_distortion": False, "refine_principal_point": False}
    result = run(drifted(made).replace(cameras={1: CAMERA}), full_turn=True, **kept)
    assert result.cameras[0].after == CAMERA.params
    assert result.cameras[0].sigma == (0.0,) * 8
    assert_as_asked(circle_errors(result.scene, made.scene))


def test_frames_without_pose_stay_without() -> None:
    made = sample()
    gone = {5, 6, 40, 41, 42}
    frames = tuple(
        dataclasses.replace(f, cam_from_world=None) if i in gone else f for i, f in enumerate(made.scene.frames)
    )
    result = run(made.scene.replace(frames=frames), full_turn=True)
    assert len(result.names) == len(result.angles) == 85
    assert [i for i, f in enumerate(result.scene.frames) if f.cam_from_world is None] == sorted(gone)
    assert any("5 of 90 frames had no pose" in remark for remark in result.remarks)
    assert_as_asked(circle_errors(result.scene, made.scene))


def test_two_cameras_have_a_mount_each() -> None:
    """The second half of the turn was filmed upside down, as some views of a turntable are."""
    made = sample()
    flip = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    points = made.scene.points
    assert points is not None
    assert points.tracks is not None
    frames = tuple(
        f
        if i < 45 or f.cam_from_world is None
        else dataclasses.replace(f, camera_id=2, cam_from_world=flip @ f.cam_from_world)
        for i, f in enumerate(made.scene.frames)
    )
    width, height = CAMERA.width, CAMERA.height
    late = points.tracks.frame >= 45
    pixel = np.where(late[:, None], [width, height] - points.tracks.pixel, points.tracks.pixel)
    fx, fy, cx, cy, *rest = CAMERA.params
    turned = dataclasses.replace(CAMERA, params=(fx, fy, width - cx, height - cy, *rest))
    truth = made.scene.replace(
        frames=frames,
        cameras={1: CAMERA, 2: turned},
        points=dataclasses.replace(points, tracks=dataclasses.replace(points.tracks, pixel=pixel)),
    )
    result = run(truth, full_turn=True)
    assert [camera.camera_id for camera in result.cameras] == [1, 2]
    assert_as_asked(circle_errors(result.scene, truth))


def test_the_result_is_a_scene_of_its_own_and_the_given_one_is_not_changed() -> None:
    made = sample(60)
    given = drifted(made)
    assert given.points is not None
    before = given.points.xyz.copy()
    result = run(given, full_turn=True, smoothness=1.0, max_points=200)
    np.testing.assert_array_equal(given.points.xyz, before)
    assert result.scene.cameras[1] != given.cameras[1]
    assert result.scene.points is not None
    assert len(result.scene.points) <= 200
    fit = fit_circle(result.scene.centres())
    # The world is the ring's; the cameras shake by 0.2 % about it.
    np.testing.assert_allclose(fit.axis, result.axis, atol=2e-3)
    np.testing.assert_allclose(fit.centre, 0.0, atol=2e-3 * result.radius)
    assert fit.radius == pytest.approx(result.radius, rel=1e-3)
    assert result.angles[0] == pytest.approx(0.0, abs=1e-6)
    table = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert table["frames"] == len(table["per_frame"]["angle"]) == 60
    assert table["arc_degrees"] == pytest.approx(result.arc_degrees)


def test_an_open_arc_with_a_free_lens_says_how_well_it_is_known() -> None:
    made = sample(40, turn=15.0, shake=0.0, orientation_shake=0.0)
    free = run(made.scene, mode="hard")
    kept = {"refine_focal": False, "refine_distortion": False, "refine_principal_point": False}
    calibrated = run(made.scene, mode="hard", **kept)
    assert free.arc_sigma is not None
    assert calibrated.arc_sigma is not None
    assert free.arc_sigma > 2 * calibrated.arc_sigma
    # Three sigma of what each says of itself; the issue asks for 1 degree of 98 with a calibrated lens, 0.15 of 15.
    assert abs(free.arc_degrees - made.angles[-1]) < 3 * free.arc_sigma
    assert abs(calibrated.arc_degrees - made.angles[-1]) < min(0.15, 3 * calibrated.arc_sigma)


def test_a_circle_that_does_not_fit_is_told() -> None:
    far = run(sample(60, shake=0.03).scene, full_turn=True, max_steps=5)
    assert any("the circle does not fit" in remark and "more slack" in remark for remark in far.remarks)
    near = run(sample(60, shake=0.008).scene, full_turn=True)
    assert any("times the radial_slack that was allowed: raise it" in remark for remark in near.remarks)


def test_steps_that_run_out_are_told_and_it_can_be_cancelled() -> None:
    made = sample(60)
    result = run(drifted(made), full_turn=True, max_steps=1, tolerance=0.0)
    assert not result.converged
    assert any("max_steps" in remark for remark in result.remarks)
    events: list[ProgressEvent] = []
    token = CancelToken()

    def listen(event: ProgressEvent) -> None:
        events.append(event)
        if len(events) == 3:
            token.cancel()
        token(event)

    with pytest.raises(Cancelled, match="stage circle"):
        close_circle(drifted(made), CircularSettings(full_turn=True), progress=listen)
    assert events[0].values["cost"] > 0


def in_place(scene: Scene, spin: str) -> Scene:
    """Cameras at places that no circle about their own axis explains."""
    frames = []
    for i, frame in enumerate(scene.frames):
        angles = {"none": [0.0, 0.0, 0.0], "own": [0.0, 0.0, 3.0 * i], "any": [50.0 * i, 70.0 * i * i, 31.0 * i]}
        rotation = Rotation.from_euler("xyz", angles[spin], degrees=True).as_matrix()
        centre = np.array([0.0, 0.0, 0.1 * i])
        frames.append(dataclasses.replace(frame, cam_from_world=RigidTransform(rotation, -rotation @ centre)))
    return scene.replace(frames=tuple(frames))


def test_what_is_no_turn_about_one_axis_is_refused() -> None:
    made = sample(30)
    with pytest.raises(StageError, match="hardly turns"):
        run(in_place(made.scene, "none"))
    with pytest.raises(StageError, match="does not move around its axis"):
        run(in_place(made.scene, "own"))
    with pytest.raises(StageError, match="about no common axis"):
        run(in_place(made.scene, "any"))


def test_bad_input_is_refused() -> None:
    made = sample(30)
    scene = made.scene
    with pytest.raises(StageError, match="at least 5; found 0 of 30"):
        run(scene.without_poses())
    with pytest.raises(StageError, match="no tracks to adjust"):
        run(scene.replace(points=None))
    assert scene.points is not None
    assert scene.points.tracks is not None
    few = dataclasses.replace(scene.points.tracks, point=scene.points.tracks.point % 3)
    with pytest.raises(StageError, match="Too few points"):
        run(scene.replace(points=dataclasses.replace(scene.points, tracks=few)))
    with pytest.raises(StageError, match="told by frame 77, which has no pose"):
        run(scene, full_turn=True, turn_last=77)
    with pytest.raises(StageError, match="begins and ends with the same frame"):
        run(scene, full_turn=True, turn_first=4, turn_last=4)
    with pytest.raises(StageError, match="runs against the camera"):
        run(scene, full_turn=True, turn_first=20, turn_last=4)
    last = (*scene.frames[:-2], dataclasses.replace(scene.frames[-2], cam_from_world=None), scene.frames[-1])
    with pytest.raises(StageError, match="step after the last frame is not known"):
        run(scene.replace(frames=last), full_turn=True)
    with pytest.raises(StageError, match="No observation is left"):
        run(sample(30, noise=40.0).scene, full_turn=True, max_error=0.1, max_steps=2)

    class Panorama:
        width, height = 480, 360

    with pytest.raises(CapabilityError, match="COLMAP's models only; found Panorama"):
        run(scene.replace(cameras={1: Panorama()}))


def test_too_many_frames_are_refused_before_the_work_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("toolkit.poses.circular._MOST_FRAMES", 20)
    with pytest.raises(StageError, match="at most 20; found 30. Take every nth frame"):
        run(sample(30).scene)
