"""The depth loss: what it is blind to, its gradients, and what a training makes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import HEIGHT, WIDTH, draw_truth, make_scene
from tiny_training import same, settings, stop_after
from torch import Tensor

from toolkit.errors import Cancelled, DataError, RunError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene
from toolkit.splat.depth_loss import (
    DepthKind,
    DepthPredictions,
    PredictedDepth,
    compared_depth,
    depth_loss,
    resampled,
)
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import load_photos, views_of
from toolkit.splat.rasterize import RasterSettings, rasterize
from toolkit.splat.train import train_splats

KINDS: tuple[DepthKind, ...] = ("scale-shift", "pearson")


def images(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """A drawn image, a prediction with holes that has something in common with it, and weights; float64."""
    generator = torch.Generator().manual_seed(seed)
    drawn, other, weights = (torch.rand(5, 7, generator=generator, dtype=torch.float64) for _ in range(3))
    prediction = 3 * drawn + 2 * other + 5
    prediction[1, 2], prediction[4] = float("nan"), float("inf")
    weights[0, :3] = 0
    return drawn, prediction, weights


def value(drawn: Tensor, prediction: Tensor, weights: Tensor, kind: DepthKind) -> Tensor:
    loss = depth_loss(drawn, prediction, weights, kind=kind)
    assert loss is not None
    return loss


def test_it_is_what_least_squares_says() -> None:
    drawn, prediction, weights = images()
    known = torch.isfinite(prediction) & (weights > 0)
    x, p, w = (image[known].numpy() for image in (drawn, prediction, weights))
    root = np.sqrt(w)
    (scale, shift), *_ = np.linalg.lstsq(np.stack([x, np.ones_like(x)], 1) * root[:, None], p * root, rcond=None)
    mean = np.average(p, weights=w)
    deviation = np.sqrt(np.average((p - mean) ** 2, weights=w))
    expected = np.average(np.abs(scale * x + shift - p), weights=w) / deviation
    assert value(drawn, prediction, weights, "scale-shift").item() == pytest.approx(expected, rel=1e-12)
    covariance = np.cov(x, p, aweights=w, ddof=0)
    correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert value(drawn, prediction, weights, "pearson").item() == pytest.approx(1 - correlation, rel=1e-12)


def test_absolute_knows_the_unit() -> None:
    drawn, prediction, weights = images()
    known = torch.isfinite(prediction) & (weights > 0)
    x, p, w = (image[known].numpy() for image in (drawn, prediction, weights))
    mean = np.average(p, weights=w)
    expected = np.average(np.abs(x - p), weights=w) / np.sqrt(np.average((p - mean) ** 2, weights=w))
    assert value(drawn, prediction, weights, "absolute").item() == pytest.approx(expected, rel=1e-12)
    assert value(prediction, prediction, weights, "absolute").item() == 0.0
    assert value(prediction + 1, prediction, weights, "absolute").item() > 0.1
    image = drawn.requires_grad_()
    assert torch.autograd.gradcheck(lambda drawn: value(drawn, prediction, weights, "absolute"), (image,))


@pytest.mark.parametrize("kind", KINDS)
def test_scale_and_shift_of_either_image_change_nothing(kind: DepthKind) -> None:
    drawn, prediction, weights = images()
    loss = value(drawn, prediction, weights, kind)
    assert 0.1 < loss < 1
    torch.testing.assert_close(value(7 * drawn - 3, prediction, weights, kind), loss)
    torch.testing.assert_close(value(drawn, 0.01 * prediction + 40, weights, kind), loss)
    torch.testing.assert_close(value(drawn, prediction, 5 * weights, kind), loss)
    assert value(drawn, 2 * drawn - 9, weights, kind) < 1e-12
    # Near and far exchanged is no change of unit.
    assert value(drawn, -drawn, weights, kind) > 1.5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sign", [1, -1], ids=["alike", "inverted"])
def test_gradients_agree_with_finite_differences(kind: DepthKind, sign: int) -> None:
    """Through the fit, too; where it has no say, no gradient."""
    drawn, prediction, weights = images(3)
    image = (sign * drawn).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: value(x, prediction, weights, kind), (image,))
    value(image, prediction, weights, kind).backward()
    assert image.grad is not None
    assert image.grad[0, :3].tolist() == [0, 0, 0]
    assert image.grad[4].abs().max() == 0
    # A move by a shift or a scale changes nothing, so the gradient is across both.
    assert abs(image.grad.sum().item()) < 1e-12
    assert abs((image.grad * image.detach()).sum().item()) < 1e-12


def test_descending_from_an_inverted_image_turns_it_round() -> None:
    _, prediction, weights = images(3)
    target = torch.where(torch.isfinite(prediction), prediction, 0)
    image = (-0.1 * target + torch.randn(5, 7, generator=torch.Generator().manual_seed(1))).requires_grad_()
    optimiser = torch.optim.Adam([image], lr=0.05)
    for _ in range(200):
        optimiser.zero_grad()
        loss = value(image, prediction, weights, "scale-shift")
        loss.backward()
        optimiser.step()
    assert loss < 0.1
    assert value(image, prediction, weights, "pearson") < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_there_is_no_loss_where_nothing_can_be_compared(kind: DepthKind) -> None:
    drawn, prediction, weights = images()
    assert depth_loss(drawn, torch.full_like(prediction, float("nan")), weights, kind=kind) is None
    assert depth_loss(drawn, prediction, torch.zeros_like(weights), kind=kind) is None
    assert depth_loss(drawn, torch.ones_like(prediction), weights, kind=kind) is None
    assert depth_loss(torch.full_like(drawn, 2.0), prediction, weights, kind=kind) is None


def test_disparity_is_one_over_depth_and_minus_depth_from_affine_cameras() -> None:
    gaussians = Gaussians(
        torch.tensor([[0.0, 0, -2.0], [0.5, 0, 3.0]]),
        torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4),
        torch.full((2, 3), -2.5),
        torch.full((2,), 2.0),
        torch.zeros(2, 1, 3),
    )
    camera = AffineCamera(11, 5, 8, 0, 8, 4, 2.5)
    output = rasterize(gaussians, views_of(camera, torch.eye(4)[None]), RasterSettings(backend="cpu"))
    assert torch.equal(compared_depth(output, predicts="disparity", affine=True), -output.expected_depth[0])
    assert torch.equal(compared_depth(output, predicts="depth", affine=True), output.expected_depth[0])
    moved = torch.eye(4)
    moved[2, 3] = 5
    output = rasterize(
        gaussians, views_of(ColmapCamera.pinhole(11, 5, 20.0), moved[None]), RasterSettings(backend="cpu")
    )
    disparity = compared_depth(output, predicts="disparity", affine=False)
    drawn = output.alpha[0] > 0
    assert drawn.any()
    assert not drawn.all()
    torch.testing.assert_close(disparity[drawn], 1 / output.expected_depth[0][drawn])
    assert torch.isfinite(disparity).all()


def test_resampling_by_area_leaves_out_what_is_not_known() -> None:
    prediction = np.array([[1, 3, 7, np.nan], [5, 7, np.nan, np.inf]], np.float64)
    small = resampled(prediction, 2, 1)
    assert small[0, 0] == 4
    assert torch.isnan(small[0, 1])  # a quarter is known
    prediction[1, 2] = 9
    assert resampled(prediction, 2, 1)[0].tolist() == [4, 8]
    assert torch.equal(resampled(prediction[:, :2], 2, 2), torch.tensor([[1.0, 3], [5, 7]]))


def test_enlarging_is_bilinear() -> None:
    ramp = np.arange(6, dtype=np.float32)[None].repeat(3, axis=0)
    large = resampled(ramp, 12, 6)
    assert large.shape == (6, 12)
    torch.testing.assert_close(large[0, 1:-1], torch.arange(10) / 2 + 0.25)


def truth_of(scene: Scene) -> dict[str, tuple[Tensor, Tensor]]:
    """Depth and alpha of every frame with a pose, as the true Gaussians have them."""
    drawn = {}
    for frame in scene.registered:
        camera = scene.camera_of(frame)
        assert isinstance(camera, ColmapCamera | AffineCamera)
        assert frame.cam_from_world is not None
        output = draw_truth(frame.cam_from_world, camera)
        drawn[frame.name] = output.expected_depth[0], output.alpha[0]
    return drawn


def predictions_of(scene: Scene, *, affine: bool) -> dict[str, np.ndarray]:
    """True disparity, in each photo with a scale and a shift of its own; NaN where hardly anything is."""
    generator, made = np.random.default_rng(0), {}
    for name, (depth, alpha) in truth_of(scene).items():
        disparity = -depth if affine else 1 / torch.where(alpha > 0, depth, 1)
        image = generator.uniform(0.5, 5) * disparity + generator.uniform(-3, 3)
        made[name] = np.where(alpha > 0.5, image, np.nan)
    return made


def held_to(predictions: dict[str, np.ndarray], weight: float, **changes: object) -> PredictedDepth:
    return PredictedDepth(predictions, "disparity", DepthLossSettings().replace({"weight": weight, **changes}))


def depth_error(gaussians: Gaussians, scene: Scene) -> float:
    """Mean difference from the true depth where the truth is opaque, in scene units, over all frames."""
    errors = []
    for frame in scene.registered:
        camera = scene.camera_of(frame)
        assert isinstance(camera, ColmapCamera | AffineCamera)
        assert frame.cam_from_world is not None
        pose = torch.tensor(frame.cam_from_world.matrix, dtype=torch.float32)[None]
        drawn = rasterize(gaussians, views_of(camera, pose), RasterSettings())
        depth, alpha = truth_of(scene)[frame.name]
        both = (alpha > 0.8) & (drawn.alpha[0] > 0.2)
        errors.append((drawn.expected_depth[0] - depth)[both].abs().mean().item())
    return float(np.mean(errors))


@pytest.mark.parametrize(("affine", "kind"), [(False, "scale-shift"), (False, "pearson"), (True, "scale-shift")])
def test_training_with_it_brings_depths_nearer_to_the_truth(tmp_path: Path, affine: bool, kind: DepthKind) -> None:
    """Few steps from noisy points on three photos, where colours alone tell little; measured: half of the error."""
    scene = make_scene(tmp_path, cameras=5, points=100, noise=0.3, affine=affine)
    predictions = predictions_of(scene, affine=affine)
    chosen = settings(steps=150, densify_stop=0.0, lr_means=2e-3, lr_means_final=2e-4)
    plain = train_splats(scene, chosen, seed=0)
    held = train_splats(scene, chosen, seed=0, predicted_depth=held_to(predictions, 0.03, kind=kind))
    assert depth_error(held.gaussians, scene) < 0.75 * depth_error(plain.gaussians, scene)
    assert held.notes == ()


def test_a_resumed_training_with_it_is_the_uninterrupted_one(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "scene")
    predictions = predictions_of(scene, affine=False)
    chosen = settings(steps=30, coarse_to_fine=True)
    held = held_to(predictions, 0.5)
    whole = train_splats(scene, chosen, seed=3, predicted_depth=held)
    folder = tmp_path / "checkpoints"
    with pytest.raises(Cancelled):
        train_splats(
            scene,
            chosen,
            seed=3,
            predicted_depth=held,
            checkpoint_dir=folder,
            progress=stop_after(13),
        )
    changed = held_to(predictions | {"01.png": predictions["01.png"] + 1}, 0.5)
    with pytest.raises(RunError, match="belongs to another run; expected depth predictions = "):
        train_splats(scene, chosen, seed=3, predicted_depth=changed, checkpoint_dir=folder)
    with pytest.raises(RunError, match=r"belongs to another run; expected depth loss\.weight = "):
        train_splats(scene, chosen, seed=3, predicted_depth=held_to(predictions, 0.4), checkpoint_dir=folder)
    resumed = train_splats(scene, chosen, seed=3, predicted_depth=held, checkpoint_dir=folder)
    assert resumed.resumed_at == 13
    assert same(whole.gaussians, resumed.gaussians)


def test_the_weight_falls_exponentially() -> None:
    falling = held_to({}, 1.0, final_weight=0.01)
    assert [falling.weight_at(step, 101) for step in (1, 51, 101)] == pytest.approx([1.0, 0.1, 0.01])
    assert held_to({}, 0.5, final_weight=0.0).weight_at(101, 101) == 0.5


def test_missing_predictions_are_told(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    one = {"01.png": predictions_of(scene, affine=False)["01.png"]}
    held = train_splats(scene, settings(steps=1), seed=0, predicted_depth=held_to(one, 1.0))
    assert held.notes == ("5 of 6 training photos have no predicted depth.",)


@pytest.mark.parametrize("given", [{}, {"unknown.png": np.ones((4, 6))}])
def test_no_prediction_for_any_photo_is_refused(tmp_path: Path, given: dict[str, np.ndarray]) -> None:
    scene = make_scene(tmp_path)
    with pytest.raises(
        StageError, match=r"no predicted depth.*none for the 6 training photos\. Hand in predictions"
    ):
        train_splats(scene, settings(steps=1), seed=0, predicted_depth=held_to(given, 1.0))


@pytest.mark.parametrize("shape", [(WIDTH, HEIGHT), (HEIGHT, WIDTH, 1), (0, 0)])
def test_a_prediction_of_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    scene = make_scene(tmp_path)
    with pytest.raises(DataError, match=r"depth of frame '01.png' does not fit.*ratio of 36x24; found \("):
        train_splats(scene, settings(steps=1), seed=0, predicted_depth=held_to({"01.png": np.ones(shape)}, 1.0))


def test_predictions_of_any_size_fit_the_same_shape(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    photos = load_photos(scene, scene.of_split("train"), 800)
    predictions = DepthPredictions(
        held_to({photos[0].name: np.ones((56, 84))}, 1.0), [photo.name for photo in photos]
    )
    whole, half = predictions.of_photo(photos[0]), predictions.of_photo(photos[0].shrunk(2))
    assert whole is not None
    assert half is not None
    assert (whole.shape, half.shape) == ((24, 36), (12, 18))
    assert predictions.of_photo(photos[0]) is whole
    assert predictions.of_photo(photos[1]) is None
