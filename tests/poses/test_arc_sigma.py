"""The standard deviation of an arc against the scatter of adjustments of the same scene with other noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from arc_matches import FISHEYE, MILD, arc_scene

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.metrics.circle import fit_circle
from toolkit.poses.adjust import adjust
from toolkit.poses.arc_sigma import arc_sigma, gradient_of
from toolkit.poses.normal_equations import normal_equations
from toolkit.scene import Points, Scene, Tracks, scene_from_pycolmap, scene_to_pycolmap

TIMES = 20


def adjusted(scene: Scene, *, free: bool) -> Scene:
    model = scene_to_pycolmap(scene)
    adjust(
        model,
        refine_focal=free,
        refine_distortion=free,
        refine_principal_point=False,
        max_error=1e9,
        min_angle=0.0,
        threads=1,
    )
    return scene_from_pycolmap(model, scene.image_dir, like=scene.without_poses())


def with_noise(truth: Scene, rng: np.random.Generator, sigma: float = 0.5) -> Scene:
    assert truth.points is not None
    assert truth.points.tracks is not None
    tracks = truth.points.tracks
    moved = tracks.pixel + sigma * rng.normal(size=tracks.pixel.shape)
    return truth.replace(
        points=Points(truth.points.xyz, truth.points.rgb, tracks=Tracks(tracks.point, tracks.frame, moved))
    )


@pytest.mark.parametrize("camera", [MILD, FISHEYE], ids=lambda camera: camera.model)
def test_the_sigma_is_the_scatter_of_adjustments_with_other_noise(tmp_path: Path, camera: ColmapCamera) -> None:
    """The scatter of 20 values is itself known to 16 %: within three of those."""
    truth = arc_scene(tmp_path, camera, frames=10, arc=40.0, points=450, noise=0.0)
    rng = np.random.default_rng(1)
    free, fixed, told = [], [], []
    for _ in range(TIMES):
        noisy = with_noise(truth, rng)
        fit = adjusted(noisy, free=True)
        free.append(fit_circle(fit.centres()).arc_degrees)
        fixed.append(fit_circle(adjusted(noisy, free=False).centres()).arc_degrees)
        if len(told) < 3:
            told.append(arc_sigma(fit))
    sigma, sigma_fixed = (np.mean([getattr(each, name) for each in told]) for name in ("sigma", "sigma_fixed"))
    assert np.std(free, ddof=1) == pytest.approx(sigma, rel=0.5)
    assert np.std(fixed, ddof=1) == pytest.approx(sigma_fixed, rel=0.5)
    # The mean of 20 lies within three of its standard errors of the truth.
    assert abs(np.mean(fixed) - 40.0) < 3 * sigma_fixed / np.sqrt(TIMES)
    assert sigma > 1.2 * sigma_fixed
    # Thousands of residuals tell their noise to a few percent.
    assert told[0].noise == pytest.approx(0.5, rel=0.05)
    assert told[0].to_dict()["frames"] == 10


def test_intrinsics_that_were_kept_have_no_part_in_the_sigma(tmp_path: Path) -> None:
    scene = arc_scene(tmp_path, MILD, frames=8, arc=40.0)
    found = arc_sigma(scene, refine_focal=False, refine_distortion=False)
    # Two factorisations of the same matrix differ by rounding.
    assert found.sigma == pytest.approx(found.sigma_fixed, rel=1e-9)
    assert found.focal_sigma is None
    more = arc_sigma(scene, refine_principal_point=True)
    assert more.sigma is not None
    assert found.sigma is not None
    assert more.sigma > found.sigma


def test_the_sigma_does_not_depend_on_which_camera_holds_the_place(tmp_path: Path) -> None:
    """The first registered camera holds it: another one where the frames come in reverse. The arc stays."""
    scene = arc_scene(tmp_path, MILD, frames=8, arc=40.0)
    assert scene.points is not None
    assert scene.points.tracks is not None
    tracks = scene.points.tracks
    turned = scene.replace(
        frames=scene.frames[::-1],
        points=dataclasses.replace(scene.points, tracks=Tracks(tracks.point, 7 - tracks.frame, tracks.pixel)),
    )
    one, other = arc_sigma(scene), arc_sigma(turned)
    assert other.arc_degrees == pytest.approx(one.arc_degrees, abs=1e-6)
    # Rounding of a badly conditioned system: a part in ten thousand.
    assert other.sigma == pytest.approx(one.sigma, rel=1e-4)


def test_a_lens_that_nothing_determines_has_no_sigma(tmp_path: Path) -> None:
    """Of rays that are all but parallel to the axis the pictures tell neither focal length nor distortion."""
    scene = arc_scene(tmp_path, MILD, frames=8, arc=40.0, points=60)
    lost = scene.replace(cameras={1: ColmapCamera("OPENCV_FISHEYE", 480, 360, (4e5, 4e5, 240, 180, 0, 0, 0, 0))})
    found = arc_sigma(lost)
    assert found.sigma is None or found.sigma > 100


def test_the_equations_are_those_of_the_adjustment(tmp_path: Path) -> None:
    """Reduced matrix against a dense Jacobian of all unknowns by finite differences of the projection itself."""
    scene = arc_scene(tmp_path, MILD, frames=3, arc=15.0, points=60, noise=0.0)
    equations = normal_equations(scene, focal=True, distortion=True, principal_point=True)
    assert scene.points is not None
    assert scene.points.tracks is not None
    tracks, camera = scene.points.tracks, scene.cameras[1]
    assert isinstance(camera, ColmapCamera)
    points = scene.points.xyz
    start = np.zeros(18 + len(camera.params) + points.size)

    def project(values: np.ndarray) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        poses, lens, moved = np.split(values, [18, 18 + len(camera.params)])
        made = ColmapCamera(camera.model, 480, 360, tuple(np.array(camera.params) + lens)).to_pycolmap()
        world = points + moved.reshape(points.shape)
        pixels = np.zeros((len(tracks.point), 2))
        for index, frame in enumerate(scene.frames):
            pose, change = frame.cam_from_world, poses[6 * index : 6 * index + 6]
            assert pose is not None
            rotation = Rotation.from_rotvec(change[:3]).as_matrix() @ pose.rotation
            rows = tracks.frame == index
            inside = (world[tracks.point[rows]] - pose.centre - change[3:]) @ rotation.T
            pixels[rows] = np.asarray(made.img_from_cam(inside))
        return pixels.ravel()

    step = 1e-6
    jacobian = np.stack(
        [(project(start + move) - project(start - move)) / (2 * step) for move in step * np.eye(len(start))], axis=1
    )
    whole = jacobian.T @ jacobian
    cut = 18 + len(camera.params)
    reduced = whole[:cut, :cut] - whole[:cut, cut:] @ np.linalg.inv(whole[cut:, cut:]) @ whole[cut:, :cut]
    mine = equations.matrix.toarray()
    scale = np.sqrt(np.diagonal(whole)[:cut])
    # Finite differences on both sides: 1e-6 of the diagonal.
    np.testing.assert_allclose(mine / np.outer(scale, scale), reduced / np.outer(scale, scale), atol=2e-6)
    assert equations.observations == len(tracks.point)


def test_a_gradient_by_differences_is_that_of_the_measure() -> None:
    centres = np.arange(12.0).reshape(4, 3)
    found = gradient_of(lambda places: float(np.sum(places**2)), centres, step=1e-4)
    np.testing.assert_allclose(found, 2 * centres, atol=1e-8)


def test_without_tracks_or_with_too_few_the_reason_is_told(tmp_path: Path) -> None:
    scene = arc_scene(tmp_path, MILD, frames=8, arc=40.0)
    with pytest.raises(StageError, match="poses and tracks"):
        arc_sigma(scene.replace(points=None))
    assert scene.points is not None
    assert scene.points.tracks is not None
    tracks = scene.points.tracks
    nothing = Tracks(tracks.point[:1], tracks.frame[:1], tracks.pixel[:1])
    with pytest.raises(StageError, match="two registered frames"):
        arc_sigma(scene.replace(points=dataclasses.replace(scene.points, tracks=nothing)))
    few = tracks.point < 3
    thin = Tracks(tracks.point[few], tracks.frame[few], tracks.pixel[few])
    with pytest.raises(StageError, match="too few observations"):
        arc_sigma(scene.replace(points=dataclasses.replace(scene.points, tracks=thin)))
