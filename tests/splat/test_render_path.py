"""Paths lead where they should at an even pace, and what is rendered along them is what the rasterizer draws."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import HEIGHT, WIDTH, true_gaussians

from toolkit.errors import Cancelled, DataError, RunError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Georeference, Scene
from toolkit.splat.rasterize import RasterSettings, Views, rasterize
from toolkit.splat.render_path import (
    What,
    depth_colours,
    fly_through,
    render_frames,
    scene_turntable,
    turntable,
    up_direction,
    write_pictures,
    write_video,
)

CAMERA = ColmapCamera.pinhole(WIDTH, HEIGHT, 38.0)
EXACT = RasterSettings(backend="reference")
POSE = RigidTransform.look_at((0.0, -4.0, 0.5), (0, 0, 0))


def scene_of(poses: list[RigidTransform | None], georeference: Georeference | None = None) -> Scene:
    frames = tuple(Frame(f"{i}.png", 1, pose) for i, pose in enumerate(poses))
    return Scene(Path("none"), {1: CAMERA}, frames, georeference=georeference)


def winding() -> Scene:
    """Keyframes at uneven distances on a winding way, looking ahead and inwards; one is not registered."""
    at = np.array([0.0, 0.3, 0.5, 1.1, 1.3, 1.9, 2.0, 2.6])
    centres = np.stack([4 * np.cos(at), 4 * np.sin(at), 0.5 * np.sin(3 * at)], axis=1)
    poses: list[RigidTransform | None] = [RigidTransform.look_at(centre, (0, 0, 0)) for centre in centres]
    return scene_of([*poses[:3], None, *poses[3:]])


# ------------------------------------------------------------------------------------------------- turntable


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -2, 0), (1, 1, 0.5)])
def test_a_turntable_looks_at_its_centre_from_a_circle(up: tuple[float, float, float]) -> None:
    centre, axis = np.array([1.0, -2.0, 0.5]), np.array(up) / np.linalg.norm(up)
    poses = turntable(centre, frames=12, radius=3.0, elevation=25, up=up)
    offsets = np.array([pose.centre for pose in poses]) - centre
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3.0)
    np.testing.assert_allclose(offsets @ axis, 3 * math.sin(math.radians(25)))
    for pose in poses:
        # The centre is on the optical axis, and up is up in the picture.
        np.testing.assert_allclose(pose.apply(centre), [0, 0, 3], atol=1e-12)
        assert abs(pose.rotation[0] @ axis) < 1e-12
        assert -pose.rotation[1] @ axis > 0.9
    # Closed: the step from the last to the first is a step like every other, and one way round.
    steps = np.roll(offsets, -1, axis=0) - offsets
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.linalg.norm(steps[0]))
    assert (np.cross(offsets, np.roll(offsets, -1, axis=0)) @ axis > 0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "Too few frames; expected at least 1; found 0"),
        ({"radius": 0.0}, "radius is out of range; expected more than 0; found 0.0"),
        ({"radius": math.inf}, "radius is out of range"),
        ({"elevation": 90.0}, "elevation is out of range; expected between -90 and 90 degrees; found 90.0"),
        ({"up": (0, 0, 0)}, "up has no direction"),
    ],
)
def test_impossible_turntables_are_refused(changes: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"frames": 4, "radius": 1.0, "elevation": 30.0, **changes}
    with pytest.raises(SettingsError, match=message):
        turntable((0, 0, 0), **arguments)


def test_the_turntable_of_a_scene_is_as_far_and_high_as_its_cameras() -> None:
    poses = turntable((1, 2, 3), frames=9, radius=5.0, elevation=40)
    points = np.array([1, 2, 3]) + np.random.default_rng(0).normal(0, 0.01, (501, 3))
    points[:20] = 1e4  # far away is not the middle
    made = scene_turntable(scene_of(list(poses)), points, 6)
    assert len(made) == 6
    middle = np.median(points, axis=0)
    for pose in made:
        seen = pose.apply(middle)
        np.testing.assert_allclose(seen, [0, 0, 5], atol=0.05)
        assert abs(pose.centre[2] - 3 - 5 * math.sin(math.radians(40))) < 0.05


def test_what_cannot_be_turned_around_is_told() -> None:
    scene = scene_of([POSE])
    with pytest.raises(StageError, match="Nothing to turn around; expected at least one point; found none"):
        scene_turntable(scene, np.empty((0, 3)), 4)
    with pytest.raises(StageError, match="No circle leads around the points"):
        scene_turntable(scene, POSE.centre, 4)


def test_up_is_z_or_that_of_the_pictures() -> None:
    tilted = turntable((0, 0, 0), frames=8, radius=2, elevation=20, up=(0, -1, 0))
    np.testing.assert_allclose(up_direction(scene_of(list(tilted))), [0, -1, 0], atol=1e-12)
    found = up_direction(scene_of(list(tilted), Georeference(48.0, 9.0, 500.0)))
    assert found.tolist() == [0, 0, 1]
    # Straight down along all headings the pictures' up cancels out; the line of sight does not.
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    turns = [np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    nadir = [RigidTransform(turn @ down, np.array([0.0, 0, 5])) for turn in turns]
    np.testing.assert_allclose(up_direction(scene_of(list(nadir))), [0, 0, 1], atol=1e-12)


def test_cameras_that_are_turned_every_way_tell_no_up() -> None:
    flip = np.diag([1.0, -1, -1])
    turned = [RigidTransform(np.eye(3), np.zeros(3)), RigidTransform(flip, np.zeros(3))]
    with pytest.raises(StageError, match="It cannot be told which way is up; expected cameras that agree"):
        up_direction(scene_of(list(turned)))
    with pytest.raises(StageError, match="has no poses"):
        up_direction(scene_of([None]))


# ------------------------------------------------------------------------------------------------- fly-through


@pytest.mark.parametrize("smooth", [True, False])
def test_a_flight_passes_through_its_keyframes_in_order(smooth: bool) -> None:
    scene = winding()
    poses = fly_through(scene, 2001, smooth=smooth)
    centres = np.array([pose.centre for pose in poses])
    step = np.linalg.norm(np.diff(centres, axis=0), axis=1).max()
    nearest = []
    for frame in scene.registered:
        assert frame.cam_from_world is not None
        gap = np.linalg.norm(centres - frame.cam_from_world.centre, axis=1)
        nearest.append(int(gap.argmin()))
        assert gap.min() <= step
        found = poses[nearest[-1]].rotation @ frame.cam_from_world.rotation.T
        assert math.degrees(rotation_angle(found)) < 0.2  # between two of 2001 poses
    assert nearest == sorted(nearest)
    assert (nearest[0], nearest[-1]) == (0, 2000)


@pytest.mark.parametrize("smooth", [True, False])
def test_the_speed_is_constant(smooth: bool) -> None:
    centres = np.array([pose.centre for pose in fly_through(winding(), 200, smooth=smooth)])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    if smooth:
        assert steps.max() / steps.min() < 1.05
    else:  # a step over a corner is shorter
        assert np.quantile(steps, 0.9) / np.quantile(steps, 0.1) < 1.05


def test_a_flight_turns_evenly_and_stays_near_its_way() -> None:
    poses = fly_through(winding(), 100)
    for pose in poses:
        # The keyframes look at the origin from 4 units; in between the spline and the slerp hardly leave that.
        assert pose.apply([0, 0, 0])[2] == pytest.approx(np.linalg.norm(pose.centre), abs=0.02)
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)


def test_waiting_takes_no_time_and_two_places_are_enough() -> None:
    one, two = RigidTransform(np.eye(3), np.zeros(3)), RigidTransform(np.eye(3), np.array([-2.0, 0, 0]))
    poses = fly_through(scene_of([one, one, two, two]), 5)
    np.testing.assert_allclose([pose.centre for pose in poses], [[0.5 * i, 0, 0] for i in range(5)], atol=1e-12)


@pytest.mark.parametrize(("poses", "found"), [([None, None], 0), ([POSE], 1), ([POSE, POSE, None], 2)])
def test_without_two_places_there_is_no_flight(poses: list[RigidTransform | None], found: int) -> None:
    with pytest.raises(StageError, match=f"no way to fly along; expected .* two places or more; found {found} reg"):
        fly_through(scene_of(poses), 10)


def test_a_flight_has_two_frames() -> None:
    with pytest.raises(SettingsError, match="Too few frames; expected at least 2; found 1"):
        fly_through(winding(), 1)


# ------------------------------------------------------------------------------------------------- pictures


def test_colours_are_those_of_the_rasterizer() -> None:
    gaussians = true_gaussians()
    poses = turntable((0, 0, 0), frames=3, radius=4, elevation=10)
    pictures = list(render_frames(gaussians, CAMERA, poses, background=(0, 0.5, 1), settings=EXACT))
    assert len(pictures) == 3
    for pose, picture in zip(poses, pictures, strict=True):
        views = Views(
            torch.tensor(pose.matrix, dtype=torch.float32)[None],
            torch.tensor(CAMERA.intrinsics, dtype=torch.float32)[None],
            WIDTH,
            HEIGHT,
        )
        expected = rasterize(gaussians, views, EXACT, background=torch.tensor([0, 0.5, 1])).colour[0]
        assert picture.dtype == np.uint8
        assert np.array_equal(picture, (255 * expected.clamp(0, 1)).round().numpy().astype(np.uint8))


@pytest.mark.parametrize("what", ["depth", "median_depth"])
def test_depths_have_one_scale_along_the_path(what: What) -> None:
    near = RigidTransform.look_at((0, -3.0, 0), (0, 0, 0))
    far = RigidTransform.look_at((0, -6.0, 0), (0, 0, 0))
    closer, farther = render_frames(
        true_gaussians(), CAMERA, [near, far], what=what, background=(1, 0, 0), settings=EXACT
    )
    drawn = [(picture != (255, 0, 0)).any(-1) for picture in (closer, farther)]
    # Viridis grows brighter with the distance; nothing there shows the background.
    assert 0 < drawn[1].sum() < drawn[0].sum() < drawn[0].size
    assert closer[drawn[0]].mean() + 20 < farther[drawn[1]].mean()


def test_alpha_is_grey() -> None:
    (picture,) = render_frames(true_gaussians(), CAMERA, [POSE], what="alpha", settings=EXACT)
    assert (picture == picture[..., :1]).all()
    assert picture.min() < 20
    assert picture.max() > 230


def test_colours_of_depth_run_from_dark_to_bright_and_stop_at_the_ends() -> None:
    colours = depth_colours([0.0, 1.0, 1.5, 2.0, 9.0], 1.0, 2.0)
    assert colours[0].tolist() == colours[1].tolist() == [0x44, 0x01, 0x54]
    assert colours[3].tolist() == colours[4].tolist() == [0xFD, 0xE7, 0x25]
    assert (np.diff(depth_colours(np.linspace(0, 1, 50), 0, 1).astype(int) @ [2, 7, 1]) > 0).all()  # luminance
    assert depth_colours(np.ones((2, 3)), 1.0, 1.0).shape == (2, 3, 3)


def test_what_cannot_be_rendered_is_told_at_the_call() -> None:
    with pytest.raises(SettingsError, match="expected colour, depth, median_depth, alpha; found heat"):
        render_frames(true_gaussians(), CAMERA, [POSE], what="heat")
    bent = ColmapCamera("SIMPLE_RADIAL", WIDTH, HEIGHT, (38.0, 18.0, 12.0, 0.1))
    with pytest.raises(
        DataError, match="The camera cannot be drawn; expected a pinhole camera; found SIMPLE_RADIAL"
    ):
        render_frames(true_gaussians(), bent, [POSE])


def test_progress_is_told_and_cancels() -> None:
    events: list[ProgressEvent] = []
    list(render_frames(true_gaussians(), CAMERA, [POSE, POSE], settings=EXACT, progress=events.append))
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("splat.render", done, 2) for done in range(3)
    ]

    def stop(event: ProgressEvent) -> None:
        if event.done == 1:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        list(render_frames(true_gaussians(), CAMERA, [POSE, POSE], settings=EXACT, progress=stop))


# ------------------------------------------------------------------------------------------------- files


def test_pictures_become_files_or_nothing(tmp_path: Path) -> None:
    pictures = list(render_frames(true_gaussians(), CAMERA, [POSE, POSE], settings=EXACT))
    assert write_pictures(pictures, tmp_path / "made" / "here") == 2
    assert [path.name for path in sorted((tmp_path / "made" / "here").iterdir())] == ["00000.png", "00001.png"]
    with Image.open(tmp_path / "made" / "here" / "00001.png") as picture:
        assert np.array_equal(np.asarray(picture), pictures[1])
    with pytest.raises(RunError, match="here is there already; expected a new name"):
        write_pictures(pictures, tmp_path / "made" / "here")
    with pytest.raises(DataError, match="No pictures to write"):
        write_pictures([], tmp_path / "empty")
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_a_video_has_the_frames(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    poses = turntable((0, 0, 0), frames=6, radius=4, elevation=10)
    pictures = list(render_frames(true_gaussians(), CAMERA, poses, settings=EXACT))
    assert write_video(pictures, tmp_path / "a.mp4", frames_per_second=12) == 6
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == 6 * [(HEIGHT, WIDTH, 3)]
    gap = np.array([[np.abs(a.astype(float) - b).mean() for b in pictures] for a in frames])
    assert gap.argmin(axis=1).tolist() == list(range(6))
