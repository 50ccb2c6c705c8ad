"""The CPU rasterizer against the float64 reference, and against itself."""

from __future__ import annotations

import threading

import numba
import pytest
import torch
from raster_scenes import (
    SCENES,
    RasterScene,
    cameras,
    gaussians_in,
    one_gaussian,
    straight_view,
    together,
    undecided_pixels,
)
from torch import Tensor

from toolkit.errors import CapabilityError
from toolkit.geometry.compiled import launching, threading_layer
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.rasterize import BackendName, RasterSettings, RenderOutput, Views, rasterize

# Pixels in which an alpha is so near 1/255 (relative), or a transmittance so near 1e-4 (ten times as much), that
# rounding decides are left out of comparisons: see undecided_pixels. They are a few in a thousand.
MARGIN = 3e-4


def draw(
    scene: RasterScene, backend: BackendName, xi: Tensor, keep: Tensor | None = None
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Draw, and differentiate random combinations of the pixels to keep."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    gaussians = scene.gaussians.map(lambda tensor: tensor.to(dtype).clone().requires_grad_())
    background = torch.tensor([0.25, 0.5, 0.75], dtype=dtype, requires_grad=True)
    motion = xi.to(dtype).clone().requires_grad_()
    pose = exp_se3(motion) @ scene.views.cam_from_world.to(dtype)
    views = Views(pose, scene.views.intrinsics.to(dtype), scene.views.width, scene.views.height)
    output = rasterize(gaussians, views, RasterSettings(near=scene.near, backend=backend), background=background)
    if keep is None:
        return output, {}
    output.means2d.retain_grad()
    generator = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=dtype)
    for image in (output.colour, output.alpha, output.expected_depth):
        weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        weights = weights * keep.reshape(*keep.shape, *[1] * (image.ndim - 3))
        loss = loss + (weights.to(dtype) * image).sum()
    loss.backward()
    tensors = dict(gaussians.named()) | {"background": background, "xi": motion, "means2d": output.means2d}
    gradients = {name: tensor.grad for name, tensor in tensors.items()}
    assert all(gradient is not None for gradient in gradients.values())
    return output, {name: gradient for name, gradient in gradients.items() if gradient is not None}


def moved(scene: RasterScene, xi: Tensor) -> RasterScene:
    """The scene with its cameras moved."""
    views = scene.views
    return RasterScene(
        scene.gaussians,
        Views(exp_se3(xi) @ views.cam_from_world, views.intrinsics, views.width, views.height),
        scene.near,
    )


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("motion", [0.0, 0.05], ids=["at xi = 0", "at xi != 0"])
def test_images_and_gradients_are_those_of_the_reference(name: str, motion: float) -> None:
    """Values to 1e-4 (depths relative), gradients to 1e-3 of their norm: float32 in sums of many terms.

    Measured at worst: 4e-6 in colour and alpha, 3e-5 in depth, 4e-5 in a gradient.
    """
    scene = SCENES[name]
    xi = motion * torch.tensor([1.0, -0.5, 0.5, -1.0, 0.5, 1.0], dtype=torch.float64)
    xi = xi.to(torch.float32).to(torch.float64).expand(len(scene.views), 6)
    images, _ = draw(scene, "reference", xi)
    keep = ~undecided_pixels(moved(scene, xi), images.colour, MARGIN)
    assert keep.to(torch.float64).mean() > 0.99
    expected, expected_gradients = draw(scene, "reference", xi, keep)
    found, gradients = draw(scene, "cpu", xi, keep)

    assert torch.equal(found.radii > 0, expected.radii > 0)
    assert (found.radii - expected.radii).abs().max() <= 1  # rounding up can go either way
    assert (expected.radii > 0).sum() > 20
    assert (found.colour - expected.colour)[keep].abs().max() < 1e-4
    assert (found.alpha - expected.alpha)[keep].abs().max() < 1e-4
    scale = expected.expected_depth.max()
    assert (found.expected_depth - expected.expected_depth)[keep].abs().max() < 1e-4 * scale
    # Where the transmittance is a half to rounding the median may be the next Gaussian's.
    assert ((found.median_depth - expected.median_depth)[keep].abs() > 1e-5 * scale).sum() <= 1
    assert (found.means2d - expected.means2d).abs().max() < 1e-3
    for key, gradient in expected_gradients.items():
        assert gradient.norm() > 0, key
        error = (gradients[key] - gradient).norm() / gradient.norm()
        assert error < 1e-3, f"{key}: {error:.1e}"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_lower_degree_can_be_asked_for(degree: int) -> None:
    scene = SCENES["ordinary, degree 3"]
    images = []
    for backend, precise in (("reference", scene.gaussians), ("cpu", scene.gaussians.to(dtype=torch.float32))):
        gaussians = precise.map(lambda tensor: tensor.clone().requires_grad_())
        output = rasterize(gaussians, scene.views, RasterSettings(backend=backend, sh_degree=degree))
        output.colour.sum().backward()
        assert gaussians.sh.grad is not None
        assert gaussians.sh.grad[:, (degree + 1) ** 2 :].abs().max() == 0 if degree < 3 else True
        images.append(output.colour.detach())
    keep = ~undecided_pixels(scene, images[0], MARGIN)
    assert (images[1] - images[0])[keep].abs().max() < 1e-4


def test_results_repeat_to_the_bit_with_any_number_of_threads() -> None:
    """Many tiles, groups of Gaussians and views, so that threads have something to share."""
    gaussians = gaussians_in((-3, -2, 1.5), (3, 2, 6), 3000, degree=2, scale=(-3.0, 0.6))
    scene = RasterScene(gaussians, cameras(2, 200, 130, focal=120))
    xi = torch.zeros(2, 6)
    keep = torch.ones(2, 130, 200)
    most = numba.get_num_threads()
    results = []
    try:
        for threads in (most, 1, most):
            numba.set_num_threads(threads)
            results.append(draw(scene, "cpu", xi, keep))
    finally:
        numba.set_num_threads(most)
    first_output, first_gradients = results[0]
    for output, gradients in results[1:]:
        for field in ("colour", "alpha", "expected_depth", "median_depth", "radii", "means2d"):
            assert torch.equal(getattr(output, field), getattr(first_output, field)), field
        for name, gradient in gradients.items():
            assert torch.equal(gradient, first_gradients[name]), name


def test_python_threads_can_draw_at_the_same_time() -> None:
    scene = SCENES["degree 0"]
    xi, keep = torch.zeros(1, 6), torch.ones(1, 33, 70)
    _, alone = draw(scene, "cpu", xi, keep)
    found: list[dict[str, Tensor]] = []
    workers = [threading.Thread(target=lambda: found.append(draw(scene, "cpu", xi, keep)[1])) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(found) == 4
    for gradients in found:
        assert all(torch.equal(gradients[name], alone[name]) for name in alone)


def test_launches_take_turns_where_the_threading_layer_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("toolkit.geometry.compiled.threading_layer", lambda: "workqueue")
    entered = threading.Event()

    def other() -> None:
        with launching():
            entered.set()

    worker = threading.Thread(target=other)
    with launching():
        worker.start()
        assert not entered.wait(0.1)
    worker.join()
    assert entered.is_set()


def test_the_threading_layer_is_known_once_something_was_drawn() -> None:
    rasterize(one_gaussian().to(dtype=torch.float32), straight_view())
    assert threading_layer() in ("tbb", "omp", "workqueue")


def test_the_gradient_of_means2d_can_be_read_with_only_a_pose_to_learn() -> None:
    scene = SCENES["three views, degree 2"]
    pose = scene.views.cam_from_world.to(torch.float32).requires_grad_()
    views = Views(pose, scene.views.intrinsics, scene.views.width, scene.views.height)
    output = rasterize(scene.gaussians.to(dtype=torch.float32), views)
    output.means2d.retain_grad()
    output.colour.square().sum().backward()
    assert output.means2d.grad is not None
    assert output.means2d.grad.shape == (3, 150, 2)
    assert output.means2d.grad.norm() > 0
    assert pose.grad is not None
    assert pose.grad[:, :3].norm() > 0
    assert pose.grad[:, 3].abs().max() == 0


def test_memory_order_does_not_matter() -> None:
    scene = SCENES["ordinary, degree 3"]
    plain = scene.gaussians.to(dtype=torch.float32)
    strided = plain.map(lambda tensor: tensor.unsqueeze(-1).expand(*tensor.shape, 2)[..., 0])
    transposed = Gaussians(
        plain.means.T.contiguous().T,
        plain.quaternions.T.contiguous().T,
        strided.log_scales,
        strided.opacity_logits,
        plain.sh.permute(2, 1, 0).contiguous().permute(2, 1, 0),
    )
    assert not transposed.sh.is_contiguous()
    images = []
    for gaussians in (plain, transposed):
        learned = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
        output = rasterize(learned, scene.views)
        output.colour.sum().backward()  # its gradient arrives as one number, expanded
        images.append((output.colour.detach(), *(tensor.grad for _, tensor in learned.named())))
    for one, other in zip(*images, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9])
def test_any_number_of_gaussians_can_be_drawn(count: int) -> None:
    """Kernels take eight at a time: the pose's gradient must not count the padding."""
    gaussians = gaussians_in((-0.5, -0.3, 1.5), (0.5, 0.3, 3), count, degree=1) if count else None
    if gaussians is None:
        gaussians = one_gaussian().map(lambda tensor: tensor[:0])
    scene = RasterScene(gaussians, cameras(2, 33, 17))
    xi, keep = torch.zeros(2, 6, dtype=torch.float64), torch.ones(2, 17, 33)
    expected, expected_gradients = draw(scene, "reference", xi, keep)
    found, gradients = draw(scene, "cpu", xi, keep)
    torch.testing.assert_close(found.colour.double(), expected.colour, rtol=0, atol=1e-5)
    for name, gradient in expected_gradients.items():
        torch.testing.assert_close(gradients[name].double(), gradient, rtol=1e-4, atol=1e-4 * (1 + gradient.norm()))


def test_nothing_in_sight_is_background_and_has_zero_gradients() -> None:
    behind = together(*[one_gaussian((0, 0, -2))] * 12).to(dtype=torch.float32)
    behind = behind.map(lambda tensor: tensor.requires_grad_())
    background = torch.tensor([0.2, 0.4, 0.6], requires_grad=True)
    output = rasterize(behind, straight_view(), background=background)
    assert torch.equal(output.colour, background.expand(1, 21, 21, 3))
    assert output.radii.abs().max() == 0
    assert output.means2d.abs().max() == 0
    output.colour.sum().backward()
    for name, tensor in behind.named():
        assert tensor.grad is not None
        assert tensor.grad.abs().max() == 0, name
    assert background.grad is not None
    assert background.grad.tolist() == [441.0] * 3


def test_values_that_are_not_finite_are_not_drawn() -> None:
    whole = together(*[one_gaussian((0.02 * k, 0, 2)) for k in range(5)]).to(dtype=torch.float32)
    expected = rasterize(whole.map(lambda tensor: tensor[3:]), straight_view()).colour
    whole.means[0, 0] = float("nan")
    whole.log_scales[1, 1] = float("inf")
    whole.quaternions[2] = float("nan")
    output = rasterize(whole, straight_view())
    assert output.radii[0, :3].tolist() == [0, 0, 0]
    assert torch.equal(output.colour, expected)


def test_equal_depths_are_drawn_in_the_order_they_are_given() -> None:
    stack = [one_gaussian(opacity=0.6, colour=(k / 4, 0, 0)) for k in range(4)]
    for order in ([0, 1, 2, 3], [2, 0, 3, 1]):
        gaussians = together(*(stack[k] for k in order))
        expected = rasterize(gaussians, straight_view(), RasterSettings(backend="reference"))
        found = rasterize(gaussians.to(dtype=torch.float32), straight_view())
        torch.testing.assert_close(found.colour.double(), expected.colour, rtol=0, atol=1e-6)


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(
        CapabilityError,
        match="cannot draw means in this precision; expected float32; found float64.*or use backend 'reference'",
    ):
        rasterize(one_gaussian(), straight_view())
    elsewhere = one_gaussian().to(dtype=torch.float32, device="meta")
    with pytest.raises(CapabilityError, match="cannot draw means on this device; expected cpu; found meta"):
        rasterize(elsewhere, straight_view())


def absolute_gradient(
    gaussians: Gaussians, views: Views, backend: BackendName, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """The absolute and the plain screen gradient of a weighted sum of colours."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    gaussians = gaussians.map(lambda tensor: tensor.to(dtype).clone().requires_grad_())
    views = Views(views.cam_from_world.to(dtype), views.intrinsics.to(dtype), views.width, views.height)
    output = rasterize(gaussians, views, RasterSettings(backend=backend, absolute_gradients=True))
    output.means2d.retain_grad()
    (weights.to(dtype)[..., None] * output.colour).sum().backward()
    absolute = output.screen_gradient()
    assert absolute is not None
    assert output.means2d.grad is not None
    return absolute.to(torch.float64), output.means2d.grad.to(torch.float64)


@pytest.mark.parametrize("name", ["ordinary, degree 3", "three views, degree 2", "needles"])
def test_absolute_gradients_are_those_of_the_reference(name: str) -> None:
    """To 1e-3 of their norm, as other gradients."""
    scene = SCENES[name]
    views = scene.views
    like = torch.empty(len(views), views.height, views.width)
    keep = ~undecided_pixels(scene, like, MARGIN)
    weights = torch.randn(keep.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * keep
    expected, plain = absolute_gradient(scene.gaussians, scene.views, "reference", weights)
    found, _ = absolute_gradient(scene.gaussians, scene.views, "cpu", weights)
    assert (found - expected).norm() < 1e-3 * expected.norm()
    assert (expected >= plain.abs() - 1e-9 * plain.abs().max()).all()
    assert expected.sum() > 1.5 * plain.abs().sum()


def test_absolute_gradients_sum_what_each_pixel_says() -> None:
    """Against one backward pass for every pixel, in float64: to rounding."""
    gaussians = together(one_gaussian((0.1, 0.05, 2)), one_gaussian((-0.1, 0.0, 2.5)))
    views = straight_view()
    generator = torch.Generator().manual_seed(2)
    weights = torch.randn(1, 21, 21, generator=generator, dtype=torch.float64)
    found, _ = absolute_gradient(gaussians, views, "reference", weights)
    expected = torch.zeros_like(found)
    for pixel in range(21 * 21):
        only = torch.zeros_like(weights).view(-1)
        only[pixel] = weights.view(-1)[pixel]
        expected += absolute_gradient(gaussians, views, "reference", only.view(1, 21, 21))[1].abs()
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_absolute_gradients_are_refused_for_disks() -> None:
    with pytest.raises(CapabilityError, match="kind '3d' only"):
        rasterize(one_gaussian(), straight_view(), RasterSettings(kind="2d", absolute_gradients=True))
