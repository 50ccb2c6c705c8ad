"""Camera models judged on made-up arcs: the true one is found, ties are told, failures are values."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from arc_matches import FISHEYE, MILD, arc_database, arc_scene

from toolkit.errors import Cancelled, DataError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import match_counts
from toolkit.poses.camera_comparison import ModelComparison
from toolkit.poses.camera_fits import odd_focal
from toolkit.poses.camera_models import CameraModelSettings, compare_models
from toolkit.poses.camera_start import nearest_camera, plain_cameras
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene


def settings(models: str, **changes: object) -> CameraModelSettings:
    # Neighbours on these arcs are 4 degrees apart.
    return CameraModelSettings().replace(
        {
            "models": models,
            "start_focal": 300.0,
            "sfm.init_min_angle": 4.0,
            "sfm.init_min_inliers": 30,
            "sfm.threads": 1,
            **changes,
        }
    )


def compared(
    truth: Scene, folder: Path, made: CameraModelSettings, *, wrong: float = 0.0, progress: Progress = silent
) -> ModelComparison:
    database = arc_database(folder / "matches.db", truth, window=6, wrong=wrong)
    return compare_models(truth, database, made, seed=0, progress=progress, work_dir=folder / "work")


@pytest.fixture(scope="module")
def fisheye(tmp_path_factory: pytest.TempPathFactory) -> ModelComparison:
    """Five models on a fish-eye's pictures, one keypoint in twenty somewhere else."""
    folder = tmp_path_factory.mktemp("fisheye")
    truth = arc_scene(folder, FISHEYE, frames=11, arc=40.0)
    models = "SIMPLE_PINHOLE, RADIAL_FISHEYE, OPENCV_FISHEYE, FOV, FULL_OPENCV"
    return compared(truth, folder, settings(models), wrong=0.05)


def test_the_true_model_is_chosen(fisheye: ModelComparison) -> None:
    assert fisheye.choice.chosen == "OPENCV_FISHEYE", fisheye.choice.reason
    assert "OPENCV_FISHEYE" in fisheye.choice.reason
    found = fisheye.fit("OPENCV_FISHEYE")
    assert found.score is not None
    # 0.5 px in each coordinate, and the point's own error: the length of a withheld residual is 0.71 px or more.
    assert 0.65 < found.score.held_out_rms < 0.95
    assert found.score.free_parameters == 6
    # The rays of the lens, wherever its parameters trade places: within a pixel and a half up to 60 degrees.
    off = np.radians(np.linspace(0, 60, 13))
    rays = np.column_stack([np.sin(off), np.zeros(13), np.cos(off)])
    miss = np.abs(found.cameras[1].project(rays) - FISHEYE.project(rays))
    scale = 240.0 / found.cameras[1].params[0]
    assert np.nanmax(miss) < 1.5 + 240.0 * abs(1.0 - scale)


def test_all_models_are_judged_by_the_same_observations(fisheye: ModelComparison) -> None:
    scores = [each.score for each in fisheye.fits if each.score is not None]
    assert len(scores) == 5
    assert len({(score.held_out, score.observations) for score in scores}) == 1
    assert 100 < scores[0].held_out <= fisheye.withheld <= fisheye.tracks
    assert all(len(each.pixels) == len(each.residuals) == fisheye.withheld for each in fisheye.fits)
    assert fisheye.verified_as == {"uncalibrated": 45}
    assert fisheye.frames == 11


def test_a_model_without_distortion_is_far_behind(fisheye: ModelComparison) -> None:
    margin = fisheye.choice.margins["SIMPLE_PINHOLE"]
    assert margin.held_out > 1.0
    assert margin.held_out > 5 * margin.held_out_error > 0
    assert margin.bic > 1000


def test_training_error_alone_chooses_nothing(fisheye: ModelComparison) -> None:
    """A rational polynomial of ten parameters fits the same withheld observations; its BIC is worse."""
    wide, true = fisheye.fit("FULL_OPENCV").score, fisheye.fit("OPENCV_FISHEYE").score
    assert wide is not None
    assert true is not None
    assert abs(wide.training_median - true.training_median) < 0.02
    assert wide.bic > true.bic + 10


def test_the_comparison_is_json(fisheye: ModelComparison) -> None:
    record = json.loads(json.dumps(fisheye.to_dict(), allow_nan=False))
    assert len(record["fits"]) == 5
    assert record["choice"]["chosen"] == "OPENCV_FISHEYE"
    assert set(record["fits"][0]["score"]) >= {"held_out_rms", "bic", "noise"}
    with pytest.raises(SettingsError, match="RADIAL was not compared"):
        fisheye.fit("RADIAL")


def test_of_models_that_all_hold_the_truth_the_simple_one_is_chosen(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=9, arc=32.0, points=1500)
    found = compared(truth, tmp_path, settings("SIMPLE_PINHOLE, SIMPLE_RADIAL, OPENCV"))
    # The choice may be open between models that contain the truth, never for one that lacks it or has too much.
    assert "SIMPLE_RADIAL" in found.choice.candidates
    assert found.choice.candidates[0] == "SIMPLE_RADIAL"
    assert found.choice.chosen in ("SIMPLE_RADIAL", None)
    camera = found.fit("SIMPLE_RADIAL").cameras[1]
    # A 32-degree arc of free intrinsics knows its focal length to some percent.
    assert camera.params[0] == pytest.approx(400.0, rel=0.1)


def test_a_model_that_fails_is_a_value_with_its_reason(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, FISHEYE, frames=9, arc=32.0)
    found = compared(truth, tmp_path, settings("SIMPLE_RADIAL, OPENCV_FISHEYE", restart=False))
    lost = found.fit("SIMPLE_RADIAL")
    assert lost.failure == lost.mapping
    assert lost.score is None
    assert lost.scene is None
    assert lost.cameras == {}
    # One coefficient of a polynomial cannot hold the corners of this lens: pictures fall out.
    assert lost.failure == f"{lost.registered} of 9 pictures placed"
    assert found.choice.chosen == "OPENCV_FISHEYE"
    assert "no other model could be fitted" in found.choice.reason


def test_the_start_knows_nothing_of_the_scenes_distortion(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, FISHEYE, frames=3, arc=10.0)
    started = plain_cameras(truth, "OPENCV_FISHEYE", 300.0)[1]
    assert started.params == (300.0, 300.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0)
    assert plain_cameras(truth, "FOV", 0.0)[1].params[:2] == (240.0, 240.0)


def test_a_focal_length_that_no_lens_has_is_no_fit(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=3, arc=10.0)
    assert odd_focal(truth) == ""
    for focal, text in ((1.7, "1.7 px"), (6000.0, "6000 px")):
        odd = truth.replace(cameras={1: ColmapCamera("SIMPLE_PINHOLE", 480, 360, (focal, 240.0, 180.0))})
        assert text in odd_focal(odd)
        assert "480 x 360 px" in odd_focal(odd)


def test_the_nearest_camera_of_another_model_sees_nearly_the_same_rays() -> None:
    pixels = np.stack(np.meshgrid(np.linspace(20, 460, 9), np.linspace(20, 340, 7)), axis=-1).reshape(-1, 2)
    rays = FISHEYE.ray(pixels)[1]
    for model, limit in (("FULL_OPENCV", 1.0), ("RADIAL_FISHEYE", 4.0), ("OPENCV_FISHEYE", 1e-6)):
        miss = np.linalg.norm(nearest_camera(FISHEYE, model).project(rays) - pixels, axis=1)
        # A rational polynomial follows this lens to a pixel, a two-coefficient one to some.
        assert np.median(miss) < limit, model


def test_settings_that_cannot_be_are_named(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=3, arc=10.0)
    for changes, message in (
        ({"models": "RADIAL, RADIALS"}, "Unknown camera model 'RADIALS'"),
        ({"models": " , "}, "names no camera model"),
        ({"sfm.refine_focal": False}, "'sfm.refine_focal' does not serve"),
        ({"sfm.refine_distortion": False}, "'sfm.refine_distortion' does not serve"),
    ):
        with pytest.raises(SettingsError, match=message):
            compare_models(
                truth, tmp_path / "no.db", CameraModelSettings().replace(changes), work_dir=tmp_path / "work"
            )


def test_too_few_tracks_and_another_scenes_database_are_refused(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=4, arc=12.0, points=60)
    with pytest.raises(StageError, match="too few long tracks"):
        compared(truth, tmp_path, settings("RADIAL"))
    other = arc_scene(tmp_path, MILD, frames=5, arc=12.0, points=60)
    with pytest.raises(DataError, match="does not belong to this scene"):
        compare_models(other, tmp_path / "matches.db", settings("RADIAL"), work_dir=tmp_path / "work")


def test_without_any_reconstruction_every_reason_is_told(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=6, arc=20.0, points=900)
    with pytest.raises(StageError, match="No camera model gave a reconstruction.*sound start"):
        compared(truth, tmp_path, settings("RADIAL", **{"sfm.init_min_inliers": 10000}))


def test_it_can_be_cancelled_and_leaves_the_database_as_it_was(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=6, arc=20.0, points=900)

    def stop(event: ProgressEvent) -> None:
        if event.stage == "camera_models.judge":
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        compared(truth, tmp_path, settings("SIMPLE_RADIAL"), progress=stop)
    inliers = match_counts(tmp_path / "matches.db")[2]
    again = arc_database(tmp_path / "again.db", truth, window=6)
    assert inliers.tolist() == match_counts(again)[2].tolist()
    assert list((tmp_path / "work").iterdir()) == []


def test_cameras_that_are_none_of_colmaps_are_refused(tmp_path: Path) -> None:
    class Odd:
        width, height = 480, 360

    truth = arc_scene(tmp_path, MILD, frames=6, arc=20.0, points=900)
    database = arc_database(tmp_path / "matches.db", truth, window=6)
    odd = truth.replace(cameras={1: Odd()})
    with pytest.raises(Exception, match="cannot be given to COLMAP") as caught:
        compare_models(odd, database, settings("RADIAL"), work_dir=tmp_path / "work")
    assert type(caught.value).__name__ == "CapabilityError"
    assert isinstance(truth.cameras[1], ColmapCamera)
