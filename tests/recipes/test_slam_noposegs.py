"""SLAM + NoposeGS: from a filmed flight to a splat; what is told where video, vocabulary or package is missing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from toolkit import optional
from toolkit.capture.flight import FlightSettings, open_flight
from toolkit.errors import DataError, MissingDependencyError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.orb_pnp import OrbPnp
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.progress import silent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput
from toolkit.recipes.flight_video import film_of, scene_by_video
from toolkit.recipes.presets import recipe_presets, with_preset
from toolkit.recipes.registry import find_recipe
from toolkit.recipes.sensor_fused import RECIPE as SENSOR_FUSED
from toolkit.recipes.slam_noposegs import ORB_PNP, ORBSLAM, TRAJECTORIES
from toolkit.samples.drone_flights import OrbitVideoSettings, make_drone_flight
from toolkit.scene import Scene
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.scene.timed_poses import TimedPoses
from toolkit.scene.trajectory_files import read_tum
from toolkit.settings import Settings
from toolkit.workspace import Workspace

pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")

FRAMES, EVERY = 36, 4
QUICK = {"train.steps": 20, "train.max_side": 64, "train.max_gaussians": 1000}

MERGE = MergeSettings()

Context = Callable[[str], RecipeContext]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> RecipeInput:
    changes = {
        "town.trees": 6,
        "flight.frames": FRAMES,
        "flight.arc": 45.0,
        "flight.height": 30.0,
        "flight.radius": 40.0,
        "flight.image_width": 240,
        "flight.image_height": 180,
        "flight.samples": 1,
        "keyframe_every": EVERY,
    }
    folder = tmp_path_factory.mktemp("filmed") / "orbit"
    made = make_drone_flight(folder, OrbitVideoSettings().replace(changes), seed=1)
    capture = open_capture(folder)
    assert capture.video == made.video
    return RecipeInput(capture.scene, capture.reference, capture_fingerprint(capture.scene), capture.video)


@pytest.fixture
def context(tmp_path: Path) -> Context:
    def make(name: str) -> RecipeContext:
        for folder in ("artifacts", "checkpoint"):
            (tmp_path / name / folder).mkdir(parents=True)
        return RecipeContext(
            Workspace(tmp_path / "work"),
            tmp_path / name / "artifacts",
            tmp_path / name / "checkpoint",
            0,
            "cpu",
            silent,
        )

    return make


def quick(recipe: Recipe, **changes: object) -> Settings:
    return recipe.settings_type().replace({**QUICK, **changes}).frozen()


@pytest.mark.parametrize("recipe", [ORBSLAM, ORB_PNP])
def test_they_are_registered_with_short_refining_trainings_and_the_papers_own_as_a_preset(recipe: Recipe) -> None:
    assert find_recipe(recipe.name) is recipe
    settings = recipe.settings_type()
    assert settings.to_dict()["train"]["refine_poses"]
    assert settings.to_dict()["train"]["steps"] == 1000
    assert "orbslam-noposegs" in recipe_presets(recipe)
    paper = with_preset(settings, "orbslam-noposegs").to_dict()["train"]
    # Table 2 of the paper.
    assert (paper["steps"], paper["densify_stop"], paper["max_anisotropy"]) == (30_000, 1.0, 10.0)
    assert (paper["lr_camera"], paper["lr_camera_final"], paper["lr_means_final"]) == (1e-3, 1e-5, 1.6e-5)


def test_a_filmed_flight_is_tracked_and_becomes_a_splat(flight: RecipeInput, context: Context) -> None:
    first = context("first")
    result = ORB_PNP.run(flight, quick(ORB_PNP), first)
    pictures = len(flight.scene)
    assert result.metrics["sfm.images"] == pictures
    assert result.metrics["slam.segments"] == 1
    # Tracking may begin a few frames late.
    tracked = result.metrics["slam.tracked"]
    assert tracked is not None
    assert pictures - 1 <= tracked <= pictures
    assert result.metrics["sfm.registered"] == tracked
    assert [time.name for time in result.times] == [
        *("slam", "place", "points", "undistort", "compile", "train", "measure")
    ]
    assert result.reports["slam"]["backend"] == "orb-pnp"
    assert result.reports["slam"]["frames"] == FRAMES
    # The path is 31 m; drift of the SLAM of our own is below one percent of it (tests/poses/test_orb_pnp.py).
    start = result.metrics["start.sim3.ate"]
    assert start is not None
    assert start < 0.4
    assert result.metrics["test.psnr"] is not None
    # Poses of all frames of the video, by their times in it.
    trajectory = read_tum(first.artifacts / TRAJECTORIES / "0.tum")
    assert len(trajectory) == result.reports["slam"]["tracked"]
    assert set(np.round(trajectory.times / 0.1).astype(int)) <= set(range(FRAMES))

    second = context("second")
    again = ORB_PNP.run(flight, quick(ORB_PNP), second)
    assert [time.name for time in again.times if time.reused] == ["slam", "place", "points", "undistort"]
    assert (second.artifacts / TRAJECTORIES / "0.tum").is_file()
    assert again.metrics["test.psnr"] == result.metrics["test.psnr"]


def test_segments_merged_by_gps_are_in_the_metres_of_the_sensors(flight: RecipeInput, context: Context) -> None:
    result = ORB_PNP.run(flight, quick(ORB_PNP, segment="merge"), context("merged"))
    assert result.reports["place"]["merged"]["segments"][0]["reason"] == ""
    assert result.scene.georeference == flight.scene.georeference
    # Unaligned: nine positions with errors of 1.5 m an axis place the path to less than one of them is off.
    off = result.metrics["start.none.pos"]
    assert off is not None
    assert off < 2.4
    # What GPS is taken for has changed: the video is not tracked again for it, nor for another choice of segments.
    for number, changes in enumerate(({"segment": "merge", "merge.drift": 2.0}, {"segment": "last"})):
        again = ORB_PNP.run(flight, quick(ORB_PNP, **changes), context(f"again{number}"))
        assert [time.name for time in again.times if time.reused] == ["slam"]
        assert (again.reports["place"]["merged"] == {}) == (changes["segment"] == "last")
    with pytest.raises(StageError, match=r"at least 5000 positions"):
        ORB_PNP.run(flight, quick(ORB_PNP, segment="merge", **{"merge.min_positions": 5000}), context("few"))


def test_what_slam_saw_joins_the_fused_sensors(flight: RecipeInput, context: Context) -> None:
    quick_fused = {**QUICK, "slam.backend": "orb-pnp"}
    tracked = ORB_PNP.run(flight, quick(ORB_PNP), context("tracked"))
    # Half of the pictures have no position, and no gimbal angles: the sensors alone cannot place these.
    frames = tuple(
        dataclasses.replace(frame, prior=None) if number % 2 else frame
        for number, frame in enumerate(flight.scene.frames)
    )
    scene = flight.scene.replace(frames=frames)
    few = {**quick_fused, "slam.merge.min_positions": 3}
    lacking = dataclasses.replace(flight, scene=scene)
    joined = SENSOR_FUSED.run(lacking, SENSOR_FUSED.settings_type().replace(few), context("joined"))
    times = {time.name: time.reused for time in joined.times}
    assert list(times)[:5] == ["slam", "place", "features", "matches", "sensors"]
    assert times["slam"], "the other method's run has tracked the video"
    assert joined.metrics["slam.tracked"] == tracked.metrics["slam.tracked"]
    missing = {frame.name for frame in frames if frame.prior is None}
    posed = {frame.name for frame in joined.scene.registered}
    assert missing <= posed
    assert set(joined.reports["sensors"]["placed_by_start"]) == missing
    assert joined.reports["sensors"]["placed_by_points"] == []
    # The path is 31 m long, and five positions with 1.5 m an axis place it.
    off = joined.metrics["poses.none.pos"]
    assert off is not None
    assert off < 3.0
    with pytest.raises(DataError, match=r"needs a video"):
        SENSOR_FUSED.run(
            dataclasses.replace(flight, video=None),
            SENSOR_FUSED.settings_type().replace(quick_fused),
            context("photos"),
        )


def test_a_video_of_which_nothing_was_tracked_is_tried_again(
    flight: RecipeInput, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def nothing(self: OrbPnp, pictures: list[Path], *_: object, **__: object) -> SlamResult:
        calls.append(len(pictures))
        return SlamResult("by hand", (), len(pictures), np.zeros(len(pictures)), 0.0, ("too dark",))

    monkeypatch.setattr(OrbPnp, "track", nothing)
    for name in ("first", "second"):
        with pytest.raises(StageError, match=rf"by hand tracked none of {FRAMES} frames.*too dark"):
            ORB_PNP.run(flight, quick(ORB_PNP), context(name))
    assert calls == [FRAMES, FRAMES]


@pytest.mark.slow
def test_orbslam3_gets_its_words_from_the_flight_and_they_are_timed_apart(
    flight: RecipeInput, context: Context
) -> None:
    pytest.importorskip("pyorbslam3", reason="the real ORB-SLAM3 (GPL) is not installed")
    settings = quick(ORBSLAM, **{"slam.pace": 0.3, "words.descriptors": 10_000, "word_frames": 10})
    result = ORBSLAM.run(flight, settings, context("run"))
    assert [time.name for time in result.times][:4] == ["vocabulary", "slam", "place", "points"]
    assert result.reports["vocabulary"]["pictures"] == 10
    assert result.reports["slam"]["backend"] == "orbslam3"
    tracked = result.metrics["slam.tracked"]
    assert tracked is not None
    # Its threads make runs differ, and on a busy machine it may begin late.
    assert tracked >= 3


def test_photos_without_a_video_are_refused(flight: RecipeInput, context: Context) -> None:
    photos = dataclasses.replace(flight, video=None)
    for recipe in (ORBSLAM, ORB_PNP):
        with pytest.raises(DataError, match=r"needs a video.*expected video\.mp4 beside scene\.json"):
            recipe.run(photos, quick(recipe), context(recipe.name))


def test_a_vocabulary_that_is_not_there_is_told_before_the_video_is_decoded(
    flight: RecipeInput, context: Context, tmp_path: Path
) -> None:
    pytest.importorskip("pyorbslam3", reason="the real ORB-SLAM3 (GPL) is not installed")
    with pytest.raises(DataError, match=r"Vocabulary .*none\.txt is missing.*Train one"):
        ORBSLAM.run(flight, quick(ORBSLAM, vocabulary=str(tmp_path / "none.txt")), context("run"))
    assert not (tmp_path / "work").exists()


def test_without_the_package_its_installation_is_told(
    flight: RecipeInput, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(module: str) -> object:
        raise ImportError(f"No module named '{module}'")

    original = optional.importlib.import_module
    monkeypatch.setattr(
        optional.importlib,
        "import_module",
        lambda name: missing(name) if name == "pyorbslam3" else original(name),
    )
    with pytest.raises(MissingDependencyError, match=r"'pyorbslam3' cannot be imported.*pip install"):
        ORBSLAM.run(flight, quick(ORBSLAM), context("run"))


def test_a_video_of_another_size_is_refused(flight: RecipeInput) -> None:
    half = flight.scene.replace(cameras={1: dataclasses.replace(flight.scene.cameras[1], width=120)})
    with pytest.raises(DataError, match=r"does not fit the camera.*expected 120x180 pixels; found 240x180"):
        film_of(dataclasses.replace(flight, scene=half))


def test_a_flight_made_of_a_video_keeps_it(flight: RecipeInput, tmp_path: Path) -> None:
    assert flight.video is not None
    settings = FlightSettings().replace({"keyframes.method": "given"})
    open_flight(flight.video, None, tmp_path / "made", settings, numbers=[0, 5, 9])
    video = open_capture(tmp_path / "made").video
    assert video is not None
    assert video.read_bytes() == flight.video.read_bytes()


# ------------------------------------------------------------------------------- poses of pictures by their times


def tracked(numbers: list[int], times: np.ndarray) -> SlamResult:
    poses = tuple(RigidTransform(np.eye(3), np.array([number, 0.0, 0.0])) for number in numbers)
    timed = TimedPoses(times[numbers], poses)
    segment = SlamSegment(timed, np.array(numbers), timed, np.array(numbers))
    return SlamResult("by hand", (segment,), len(times), np.zeros(len(times)), 0.0)


def stamped(scene: Scene, times: list[float | None]) -> Scene:
    frames = tuple(dataclasses.replace(frame, time=time) for frame, time in zip(scene.frames, times, strict=False))
    return scene.replace(frames=frames)


def test_pictures_get_the_poses_of_their_frames_and_untracked_ones_none(flight: RecipeInput) -> None:
    times = np.arange(10) / 10.0
    # Clocks are rounded: 20 ms of the 100 from frame to frame.
    scene = stamped(flight.scene, [0.02, 0.38, 0.8])
    posed = scene_by_video(scene, tracked([3, 4, 5, 8], times), "largest", times, settings=MERGE).scene
    assert [frame.time for frame in posed.frames] == [0.02, 0.38, 0.8]
    assert posed.frames[0].cam_from_world is None
    for frame, number in zip(posed.frames[1:], (4, 8), strict=True):
        assert frame.cam_from_world is not None
        assert frame.cam_from_world.translation[0] == number
    # The segment's world is not that of the sensors.
    assert posed.georeference is None


@pytest.mark.parametrize(
    ("times", "found"),
    [([0.0, None, 0.8], "1 without a time and 0 at"), ([0.0, 0.45, 0.8], "0 without a time and 1 at")],
)
def test_pictures_that_are_no_frames_of_the_video_are_refused(
    flight: RecipeInput, times: list[float | None], found: str
) -> None:
    of_video = np.arange(10) / 10.0
    with pytest.raises(DataError, match=rf"not frames of the video.*of 3 pictures {found}"):
        scene_by_video(
            stamped(flight.scene, times), tracked([3, 4, 8], of_video), "largest", of_video, settings=MERGE
        )
