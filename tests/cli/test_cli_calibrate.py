"""A camera is calibrated once, and a later run and a later video use it."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import RECIPE, FakeSettings, write_photos

from toolkit.cli import main
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.calibrate import camera_name
from toolkit.poses.camera_profile import CameraProfile, read_profile, write_profile
from toolkit.poses.profiled_capture import capture_with_profile
from toolkit.poses.sfm import SfmSettings
from toolkit.recipes import registry
from toolkit.runs.index import list_runs
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene.dataset import VIDEO_FILE, open_capture
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Group

SMALL = SampleSettings().replace(
    {
        "town.trees": 0,
        "flight.frames": 10,
        "flight.arc": 90.0,
        "flight.image_width": 240,
        "flight.image_height": 180,
        "flight.samples": 1,
        "points": 0,
    }
)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene folder whose pictures tell their camera; scene.json calls its focal length a guess."""
    folder = tmp_path_factory.mktemp("calibrate") / "town"
    make_sample(folder, SMALL, seed=1)
    return folder


def profile(width: int = 480, height: int = 360, name: str = "Sightline Town") -> CameraProfile:
    """Return the town's camera at twice the size of its pictures."""
    return CameraProfile(
        name=name,
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        params=(376.0, width / 2, height / 2, 0.001),
        focal_sigma=0.001,
        reprojection_error=0.5,
        photos=10,
        source="town",
        created="2026-06-01T10:00:00+00:00",
        seconds=10.0,
    )


def test_the_camera_of_the_town_is_found_to_a_percent(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "town.camera.json"
    command = ["calibrate", str(town), "--out", str(out), "--sift.max-features", "1500"]
    assert main(command) == 0
    said = capsys.readouterr()
    found = read_profile(out)
    # 240 px over 65 degrees: 188.4 px. The search began at 288 px; the formal standard deviation is 0.2 %.
    assert found.params[0] == pytest.approx(188.36, rel=0.01)
    assert (found.width, found.height, found.photos, found.source) == (240, 180, 10, "town")
    assert found.name in said.out
    assert "SIMPLE_RADIAL: f 18" in said.out
    assert f"written to {out} after {found.seconds:.1f} s" in said.out
    assert "sfm" in said.err  # the bar
    before = out.read_bytes()
    assert main(command) == 2
    assert f"{out} is there already. Move it away" in capsys.readouterr().err
    assert out.read_bytes() == before


class RefiningSettings(FakeSettings):
    """The fake recipe's, as if it refined cameras."""

    sfm = Group(SfmSettings(), doc="Refines cameras")


@pytest.fixture
def refining(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = dataclasses.replace(RECIPE, settings_type=RefiningSettings)
    monkeypatch.setattr(registry, "all_recipes", lambda: {"fake": recipe})


@pytest.mark.usefixtures("refining")
def test_a_run_with_a_profile_has_its_camera_and_does_not_refine_it(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, profiles = tmp_path / "runs", tmp_path / "profiles"
    own = profile(name=camera_name(open_capture(town, check=False).scene))
    write_profile(own, profiles / "mine.camera.json")
    write_profile(profile(name="another"), profiles / "another.camera.json")
    photos = town / "images"
    command = ["run", "fake", "--data", str(photos), "--runs", str(runs), "--camera"]
    assert main([*command, str(profiles)]) == 0
    assert f"Camera {own.name}, 480 x 360 px" in capsys.readouterr().err
    assert main([*command, str(profiles / "mine.camera.json"), "--set", "sfm.refine_focal=yes"]) == 0
    first, second = (run.run.record() for run in list_runs(runs))
    assert [first.settings["sfm"][f"refine_{what}"] for what in ("focal", "distortion", "principal_point")] == [
        False,
        False,
        False,
    ]
    assert second.settings["sfm"]["refine_focal"] is True
    assert first.data == second.data
    assert Path(first.data).parent == (runs / ".captures").resolve()
    capture = open_capture(Path(first.data))
    assert capture.scene.cameras == {1: own.camera.scaled(240, 180)}
    plain = open_capture(photos).scene
    assert [frame.name for frame in capture.scene.frames] == [frame.name for frame in plain.frames]
    assert capture.scene.georeference == plain.georeference
    assert all(frame.prior is not None for frame in capture.scene.frames)
    assert not (photos / "scene.json").exists()


@pytest.mark.usefixtures("refining")
def test_true_poses_and_the_video_of_a_scene_folder_stay(town: Path, tmp_path: Path) -> None:
    write_profile(profile(), tmp_path / "a.json")
    made = capture_with_profile(town, tmp_path / "a.json", tmp_path / "captures")
    capture = open_capture(made.folder)
    assert capture.reference is not None
    assert len(capture.reference.registered) == 10
    assert capture.video is None
    assert made.warnings == ()
    (town / VIDEO_FILE).write_bytes(b"a video")
    try:
        again = capture_with_profile(town, tmp_path / "a.json", tmp_path / "other")
    finally:
        (town / VIDEO_FILE).unlink()
    assert (again.folder / VIDEO_FILE).is_symlink()
    colmap = tmp_path / "colmap"
    shutil.copytree(town, colmap)
    (colmap / "scene.json").unlink()
    (told,) = capture_with_profile(colmap, tmp_path / "a.json", tmp_path / "captures").warnings
    assert told == f"the true poses of {colmap} are in a world of their own and were left out"


def test_a_folder_of_other_data_does_not_serve(town: Path, tmp_path: Path) -> None:
    write_profile(profile(), tmp_path / "a.json")
    own, moved = tmp_path / "one" / "town", tmp_path / "two" / "town"
    shutil.copytree(town, own)

    def made(folder: Path) -> Path:
        return capture_with_profile(folder, tmp_path / "a.json", tmp_path / "captures").folder

    found = [made(own)]
    assert made(own) == found[0]
    for content in (b"a video", b"another one"):
        (own / VIDEO_FILE).write_bytes(content)
        found.append(made(own))
        assert (found[-1] / VIDEO_FILE).read_bytes() == content
    scene = read_scene(own)
    first = scene.frames[0]
    assert first.cam_from_world is not None
    pose = RigidTransform(first.cam_from_world.rotation, first.cam_from_world.translation + 1.0)
    write_scene(
        scene.replace(frames=(dataclasses.replace(first, cam_from_world=pose), *scene.frames[1:]), points=None), own
    )
    found.append(made(own))
    np.testing.assert_allclose(read_scene(found[-1]).centres()[0], pose.centre, atol=1e-9)
    own.parent.rename(moved.parent)
    found.append(made(moved))
    assert read_scene(found[-1]).image_path(first).is_file()
    assert (found[-1] / VIDEO_FILE).is_file()
    assert len(set(found)) == len(found)


@pytest.mark.usefixtures("refining")
def test_a_profile_that_does_not_fit_stops_the_run(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_profile(profile(480, 270), tmp_path / "a.json")
    runs = tmp_path / "runs"
    command = ["run", "fake", "--data", str(town), "--runs", str(runs), "--camera"]
    assert main([*command, str(tmp_path / "a.json")]) == 2
    assert "'Sightline Town' does not fit pictures of 240 x 180 px" in capsys.readouterr().err
    untold = write_photos(tmp_path / "photos")
    command[3] = str(untold)
    assert main([*command, str(tmp_path)]) == 2
    assert "do not tell make and model of their camera" in capsys.readouterr().err
    assert not runs.exists()


def test_frames_of_a_video_get_the_camera_scaled_to_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    tiny = {"flight.frames": 4, "flight.image_width": 96, "flight.image_height": 72, "video": True}
    make_sample(tmp_path / "town", SMALL.replace(tiny), seed=1)
    write_profile(profile(), tmp_path / "a.json")
    write_profile(profile(480, 270), tmp_path / "wide.json")
    command = ["frames", str(tmp_path / "town" / "video.mp4"), str(tmp_path / "made")]
    command += ["--keyframes.method", "every-nth", "--camera"]
    assert main([*command, str(tmp_path / "wide.json")]) == 2
    assert "does not fit pictures of 96 x 72 px" in capsys.readouterr().err
    assert main([*command, str(tmp_path / "a.json")]) == 0
    assert f"toolkit run ... --camera {tmp_path / 'a.json'}" in capsys.readouterr().out
    assert open_capture(tmp_path / "made").scene.cameras == {1: profile().camera.scaled(96, 72)}
