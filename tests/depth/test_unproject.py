"""Points from depth: on the true surface, from training pictures only, spread and thinned."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from toolkit.depth.array_depth import ArrayDepth
from toolkit.depth.ground_depth import GroundDepth
from toolkit.depth.monocular import DepthPrediction
from toolkit.depth.providers import depth_provider
from toolkit.depth.settings import DepthSettings, GroundSettings
from toolkit.depth.unproject import thin_points, unproject_depth, usable_pixels
from toolkit.errors import Cancelled, DataError, SettingsError, StageError, WeightsMissingError
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.samples import read_depth
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import load_picture

Array = NDArray[np.float64]
Flight = tuple[Scene, Path]


class Given:
    """The same values for every frame; remembers who asked."""

    name = "given"

    def __init__(self, prediction: DepthPrediction) -> None:
        self.prediction = prediction
        self.asked: list[str] = []

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        self.asked.append(frame.name)
        return self.prediction


def level(depth: float = 62.0, **options: object) -> Given:
    """Return a provider of one depth in scene units for pictures of 40x30."""
    values = np.full((30, 40), depth, np.float32)
    return Given(DepthPrediction(values, "metric", in_scene_units=True, **options))


def test_true_depth_gives_points_on_the_true_surface(
    flight: Flight, town_distance: Callable[[Array], Array]
) -> None:
    scene, folder = flight
    settings = DepthSettings(provider="arrays", arrays=str(folder / "depth"), max_points=6000, stride=1)
    result = unproject_depth(scene.replace(points=None), depth_provider(settings), settings, seed=1)
    points = result.scene.points
    assert points is not None
    assert 4000 < len(points) <= 6000
    # Depth in single precision is good to 4e-6 m here; what is left is the judge's.
    assert town_distance(points.xyz).max() < 0.01
    report = result.to_dict()
    json.dumps(report, allow_nan=False)
    assert report["points"] == len(points)
    assert [frame["rule"] for frame in report["frames"]] == ["metric kept"] * 3


@pytest.mark.parametrize("kind", ["affine-depth", "affine-disparity"])
def test_the_scenes_points_turn_a_relative_prediction_into_the_true_surface(
    flight: Flight, tmp_path: Path, town_distance: Callable[[Array], Array], kind: str
) -> None:
    scene, folder = flight
    for frame in scene.of_split("train"):
        depth = read_depth(folder, frame).astype(np.float64)
        with np.errstate(divide="ignore"):
            values = np.where(depth > 0, depth / 30 + 5 if kind == "affine-depth" else 90 / depth - 0.4, np.nan)
        np.save(tmp_path / f"{frame.name}.npy", values)
    settings = DepthSettings(provider="arrays", arrays=str(tmp_path), kind=kind, max_points=3000)
    result = unproject_depth(scene, depth_provider(settings), settings)
    assert result.scene.points is not None
    for report in result.frames:
        assert report.fit.rule == "points"
        # The scene's points lie anywhere in a pixel of 0.5 m, the prediction at its centre.
        assert 0 < report.fit.residual < 0.01
    assert np.median(town_distance(result.scene.points.xyz)) < 0.05


def test_points_have_the_colours_of_their_pixels_and_project_back_onto_them(flight: Flight) -> None:
    scene, folder = flight
    frame = scene.of_split("train")[0]
    scene = scene.replace(frames=(frame,), points=None)
    settings = DepthSettings(stride=3, thin=False, max_points=500)
    points = unproject_depth(scene, ArrayDepth(folder / "depth"), settings).scene.points
    assert points is not None
    assert len(points) == 500
    assert frame.cam_from_world is not None
    pixels = scene.camera_of(frame).project(frame.cam_from_world.apply(points.xyz))
    # Pixel centres at +0.5, from row and column 1 on, each third.
    np.testing.assert_allclose((pixels - 1.5) / 3, np.rint((pixels - 1.5) / 3), atol=1e-9)
    column, row = np.floor(pixels).astype(int).T
    np.testing.assert_array_equal(points.rgb, load_picture(scene.image_path(frame))[row, column])


def test_test_frames_are_never_asked(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    frames = (dataclasses.replace(scene.frames[0], split="test"), scene.frames[1])
    scene = scene.replace(frames=frames)
    scene.image_path(frames[0]).unlink()
    provider = level()
    result = unproject_depth(scene, provider, DepthSettings())
    assert provider.asked == ["nadir.png"]
    assert [frame.name for frame in result.frames] == ["nadir.png"]
    assert result.scene.frames == scene.frames
    assert scene.points is None, "the scene that was given stays as it was"


def test_the_budget_is_shared_evenly_and_what_is_left_goes_on(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    even = unproject_depth(scene, level(), DepthSettings(max_points=101, thin=False, stride=1))
    assert [frame.points for frame in even.frames] == [50, 51]
    ground = GroundDepth(GroundSettings(ground_height=5.0, max_distance=75.0))
    spread = unproject_depth(scene, ground, DepthSettings(max_points=900, thin=False, stride=1))
    first, second = (frame.points for frame in spread.frames)
    assert 0 < first < 450 < second
    assert first + second <= 900


def test_the_same_seed_gives_the_same_points(flat_scene: Callable[..., Scene]) -> None:
    scene, settings = flat_scene(), DepthSettings(max_points=100)
    clouds = [unproject_depth(scene, level(), settings, seed=seed).scene.points for seed in (1, 1, 2)]
    assert all(cloud is not None for cloud in clouds)
    first, again, other = (cloud.xyz for cloud in clouds if cloud is not None)
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or np.abs(first - other).max() > 0


def test_edges_and_what_is_far_are_left_out() -> None:
    depth = np.full((9, 12), 10.0)
    depth[:, 6:] = 11.5
    usable = usable_pixels(depth, DepthSettings(edge=10.0))
    np.testing.assert_array_equal(usable.all(axis=0), [True] * 5 + [False] * 2 + [True] * 5)
    assert usable_pixels(depth, DepthSettings(edge=20.0)).all()
    assert usable_pixels(depth, DepthSettings(edge=0.0)).all()
    depth[:] = 10.0
    depth[4, 4] = np.nan
    holes = usable_pixels(depth, DepthSettings())
    assert not holes[3:6, 3:6].any(), "depth that ends is an edge"
    assert holes.sum() == depth.size - 9
    depth[4, 4] = 10.0
    depth[0, 0] = 51.0
    assert usable_pixels(depth, DepthSettings(edge=0.0, far=5.0)).sum() == depth.size - 1
    assert usable_pixels(depth, DepthSettings(edge=0.0, far=0.0)).all()
    assert not usable_pixels(np.full((3, 3), np.nan), DepthSettings()).any()


def test_edge_pixels_of_the_town_would_hang_in_the_air(
    flight: Flight, town_distance: Callable[[Array], Array]
) -> None:
    """Blurred depth, as networks give it, is off the surface at edges; leaving them out is what mends it."""
    from scipy import ndimage

    scene, folder = flight
    frame = scene.of_split("train")[0]
    scene = scene.replace(frames=(frame,), points=None)
    depth = read_depth(folder, frame)
    blurred = ndimage.uniform_filter(np.where(depth > 0, depth, 500.0), 3).astype(np.float32)
    provider = Given(DepthPrediction(blurred, "metric", in_scene_units=True))
    shares = []
    for edge in (0.0, 5.0):
        points = unproject_depth(scene, provider, DepthSettings(edge=edge, stride=1, thin=False)).scene.points
        assert points is not None
        shares.append(float(np.mean(town_distance(points.xyz) > 0.5)))
    assert shares[0] > 0.02
    assert shares[1] < 0.5 * shares[0]


def test_masked_and_doubtful_pixels_give_no_points(flat_scene: Callable[..., Scene], tmp_path: Path) -> None:
    scene = flat_scene()
    scene = scene.replace(frames=scene.frames[1:], mask_dir=tmp_path)
    settings = DepthSettings(stride=1, thin=False, min_confidence=0.5)
    mask = np.zeros((30, 40), np.uint8)
    mask[:10] = 255
    Image.fromarray(mask).save(tmp_path / "nadir.png.png")
    assert unproject_depth(scene, level(), settings).frames[0].points == 400
    confidence = np.zeros((30, 40), np.float32)
    confidence[:, :7] = 0.5
    assert unproject_depth(scene, level(confidence=confidence), settings).frames[0].points == 70
    Image.fromarray(mask[:-1]).save(tmp_path / "nadir.png.png")
    with pytest.raises(DataError, match=r"Mask .* does not fit its picture; expected 40x30; found 40x29"):
        unproject_depth(scene, level(), settings)


def test_one_point_is_kept_in_each_cube_the_one_seen_from_nearest(flat_scene: Callable[..., Scene]) -> None:
    xyz = np.array([[0.0, 0, 0], [0.4, 0, 0], [1.2, 0, 0], [0.95, 0.9, 0.8], [-0.1, 0, 0]])
    rows = thin_points(xyz, np.array([3.0, 1.0, 2.0, 0.5, 9.0]), 1.0)
    # Cubes begin at the least coordinates, -0.1.
    np.testing.assert_array_equal(rows, [1, 3])
    scene = flat_scene()
    ground = GroundDepth(GroundSettings(ground_height=5.0))
    automatic = unproject_depth(scene, ground, DepthSettings())
    assert automatic.scene.points is not None
    assert automatic.voxel > 0
    assert len(automatic.scene.points) < sum(frame.points for frame in automatic.frames)
    coarse = unproject_depth(scene, ground, DepthSettings(voxel=20.0))
    assert coarse.voxel == 20.0
    assert coarse.scene.points is not None
    assert len(coarse.scene.points) < len(automatic.scene.points) / 2


def test_frames_without_depth_are_left_out_with_their_reason(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    frames = scene.frames
    settings = DepthSettings.from_dict({"ground": {"ground_height": 66.0}})
    # Only the second camera, at 67 m, is above such a ground.
    provider = Given(DepthPrediction(np.ones((30, 40), np.float32), "affine-depth"))
    result = unproject_depth(scene, provider, settings)
    assert [frame.points > 0 for frame in result.frames] == [False, True]
    assert "'oblique.png' is not above the ground" in result.frames[0].reason
    assert "set to that of the ground" in result.frames[1].reason
    with pytest.raises(StageError, match=r"No picture gave a point \(given\).*'oblique.png'.*not above.*another"):
        unproject_depth(scene.replace(frames=frames[:1]), provider, settings)
    empty = Given(DepthPrediction(np.full((30, 40), np.nan, np.float32), "metric"))
    with pytest.raises(StageError, match="no pixel has usable depth"):
        unproject_depth(scene, empty, DepthSettings())


def test_scenes_without_posed_training_frames_are_refused(flat_scene: Callable[..., Scene]) -> None:
    with pytest.raises(StageError, match="no picture to take depth from.*found 0 of 2 frames with a pose"):
        unproject_depth(flat_scene().without_poses(), level(), DepthSettings())


def test_pictures_and_depth_of_the_wrong_size_are_refused(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    small = Given(DepthPrediction(np.ones((15, 20), np.float32), "metric"))
    with pytest.raises(DataError, match=r"'oblique.png' is not of its picture's size \(given\).*\(15, 20\)"):
        unproject_depth(scene, small, DepthSettings())
    Image.fromarray(np.zeros((31, 40, 3), np.uint8)).save(scene.image_path(scene.frames[0]))
    with pytest.raises(DataError, match="'oblique.png' differ in size; expected 40x30; found 40x31"):
        unproject_depth(scene, level(), DepthSettings())


def test_progress_is_told_and_cancels(flat_scene: Callable[..., Scene]) -> None:
    events: list[ProgressEvent] = []
    unproject_depth(flat_scene(), level(), DepthSettings(), progress=events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("depth.unproject", done, 2) for done in range(3)
    ]
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        unproject_depth(flat_scene(), level(), DepthSettings(), progress=token)


def test_the_settings_choose_the_provider(tmp_path: Path) -> None:
    assert isinstance(depth_provider(DepthSettings(provider="ground")), GroundDepth)
    arrays = depth_provider(DepthSettings(provider="arrays", arrays=str(tmp_path), kind="affine-depth"))
    assert arrays.name == f"depth maps (affine-depth) of {tmp_path.name}"
    with pytest.raises(SettingsError, match="provider 'arrays' needs a folder; expected arrays=<folder"):
        depth_provider(DepthSettings(provider="arrays"))
    with pytest.raises(SettingsError, match="'ground' says itself what its values are; expected kind=auto"):
        depth_provider(DepthSettings(provider="ground", kind="metric"))
    with pytest.raises(WeightsMissingError, match="there is no folder '/no/such/folder'"):
        depth_provider(DepthSettings(weights="/no/such/folder"))
