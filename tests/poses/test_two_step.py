"""The lens within the adjustment or taken out of the pictures first, on a made-up arc with blank pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from arc_matches import FISHEYE, HEIGHT, WIDTH, arc_database, arc_scene
from PIL import Image

from toolkit.errors import SettingsError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import create_database
from toolkit.poses.sfm import SfmSettings
from toolkit.poses.two_step import TwoStepResult, one_step, two_step
from toolkit.scene import Scene

FRAMES, ARC = 9, 32.0


def settings() -> SfmSettings:
    return SfmSettings(init_min_angle=4.0, init_min_inliers=30, threads=1)


def blank_pictures(scene: Scene) -> Scene:
    images = scene.image_dir / "images"
    images.mkdir()
    for frame in scene.frames:
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(images / frame.name)
    return scene.replace(image_dir=images)


def true_matches(truth: Scene, seen: list[Scene]) -> Callable[[Scene, Path], None]:
    """Return what finds in undistorted pictures what a true lens shows there, wherever the fitted one put it."""

    def rematch(flat: Scene, path: Path) -> None:
        seen.append(flat)
        camera = flat.cameras[1]
        assert isinstance(camera, ColmapCamera)
        again = arc_scene(path.parent, camera, frames=FRAMES, arc=ARC, seed=3)
        arc_database(path, flat.replace(points=again.points), window=6)

    return rematch


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[TwoStepResult, list[Scene], Path]:
    folder = tmp_path_factory.mktemp("two_step")
    truth = blank_pictures(arc_scene(folder, FISHEYE, frames=FRAMES, arc=ARC))
    database = arc_database(folder / "first.db", truth, window=6)
    seen: list[Scene] = []
    result = two_step(
        truth,
        database,
        "OPENCV_FISHEYE",
        settings(),
        rematch=true_matches(truth, seen),
        folder=folder / "flat",
        start_focal=300.0,
        seed=0,
        work_dir=folder / "work",
    )
    return result, seen, folder


def test_the_one_step_finds_the_lens_and_the_arc(both: tuple[TwoStepResult, list[Scene], Path]) -> None:
    first = both[0].one_step
    assert first.model == "OPENCV_FISHEYE"
    assert not first.fixed
    assert len(first.scene.registered) == FRAMES
    assert first.arc is not None
    assert first.arc.sigma is not None
    # Three standard deviations.
    assert abs(first.arc.arc_degrees - ARC) < 3 * first.arc.sigma


def test_a_lens_of_many_coefficients_begins_with_one_of_two(both: tuple[TwoStepResult, list[Scene], Path]) -> None:
    (camera,) = both[0].one_step.sfm.cameras
    # Refined from what RADIAL_FISHEYE had found: not from an undistorted lens.
    assert camera.model == "OPENCV_FISHEYE"
    assert any(abs(value) > 1e-3 for value in camera.before[4:])
    assert "lens" in both[0].one_step.sfm.seconds


def test_from_a_guess_it_places_what_the_mapper_alone_loses(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    truth = arc_scene(tmp_path / "truth", FISHEYE, frames=16, arc=12.0)
    database = arc_database(tmp_path / "matches.db", truth, window=4)
    made = SfmSettings(init_min_angle=1.0, init_min_inliers=30, threads=1)
    found = {
        simple: one_step(
            truth.without_poses(),
            database,
            "OPENCV_FISHEYE",
            made,
            start_focal=0.8 * WIDTH,
            simple_first=simple,
            work_dir=tmp_path / "work",
        )
        for simple in (True, False)
    }
    assert len(found[True].scene.registered) == 16
    truth_focal, focal = FISHEYE.params[0], found[True].sfm.cameras[0].after[0]
    # Frames within 12 degrees tell it to a twentieth or so; it began 60 % off.
    assert abs(focal / truth_focal - 1) < 0.15
    # The mapper begins with the model that is asked for, undistorted.
    assert found[False].sfm.cameras[0].before == (384.0, 384.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0)


def test_the_second_pass_keeps_a_pinhole_of_the_undistorted_pictures(
    both: tuple[TwoStepResult, list[Scene], Path],
) -> None:
    result, seen, folder = both
    second = result.two_step
    assert second is not None, result.failure
    assert second.model == "PINHOLE"
    assert second.fixed
    (flat,) = seen
    assert flat.registered == ()
    assert second.scene.cameras[1] == flat.cameras[1]
    assert flat.image_dir == folder / "flat" / "images"
    assert all((flat.image_dir / frame.name).is_file() for frame in flat.frames)
    assert second.arc is not None
    # Nothing of the lens was free, so both are the same number.
    assert second.arc.sigma == pytest.approx(second.arc.sigma_fixed)
    assert second.arc.sigma is not None
    # The second pass takes the lens for exact, which the first one did not find exactly.
    assert result.sigma is not None
    assert result.sigma > second.arc.sigma
    assert abs(second.arc.arc_degrees - ARC) < 3 * result.sigma
    assert set(result.seconds) == {"undistort", "match"}
    record = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert record["two_step"]["fixed"] is True


def test_what_the_second_pass_lacks_is_in_the_result(tmp_path: Path) -> None:
    truth = blank_pictures(arc_scene(tmp_path, FISHEYE, frames=6, arc=22.0))
    database = arc_database(tmp_path / "first.db", truth, window=5)

    def nothing(flat: Scene, path: Path) -> None:
        camera = flat.cameras[1]
        assert isinstance(camera, ColmapCamera)
        create_database(path, flat, {1: camera})

    result = two_step(
        truth,
        database,
        "OPENCV_FISHEYE",
        settings(),
        rematch=nothing,
        folder=tmp_path / "flat",
        start_focal=300.0,
        work_dir=tmp_path / "work",
    )
    assert result.two_step is None
    assert result.sigma is None
    assert "needs pictures with features" in result.failure
    assert result.one_step.scene.registered
    json.dumps(result.to_dict(), allow_nan=False)


def test_a_lens_that_is_kept_is_not_searched_for(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, FISHEYE, frames=3, arc=10.0)
    fixed = SfmSettings(refine_distortion=False)
    with pytest.raises(SettingsError, match="keep the lens from being found"):
        one_step(truth, tmp_path / "no.db", "RADIAL", fixed, work_dir=tmp_path)
