"""The adapter on gsplat: the same images and gradients as the reference, and plain words where there is no GPU.

Without a GPU gsplat's kernels do not run. What runs here is all of the adapter, on top of gsplat's own PyTorch
twins (``gsplat_twins``); the kernels themselves are compared where there is a GPU.
"""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
import torch
from gsplat_twins import GsplatTwins
from raster_scenes import SCENES, RasterScene, cameras, gaussians_in, straight_view, undecided_pixels
from torch import Tensor

from toolkit.errors import CapabilityError, MissingDependencyError
from toolkit.splat import cuda
from toolkit.splat.cuda import rasterize_cuda
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.pairs import median_pairs, sums, transmittance_before
from toolkit.splat.rasterize import RasterSettings, RenderOutput, Views, rasterize
from toolkit.splat.reference import project, rasterize_reference
from toolkit.splat.reference_2d import rasterize_reference_2d

BACKGROUND = torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64)
IMAGES = ("colour", "alpha", "expected_depth", "median_depth")


@pytest.fixture
def twins(monkeypatch: pytest.MonkeyPatch) -> GsplatTwins:
    made = GsplatTwins()
    monkeypatch.setitem(sys.modules, "gsplat", made)
    monkeypatch.setattr(cuda, "_require_gpu", lambda gaussians: None)
    return made


def small(seed: int = 0, count: int = 60, views: int = 2) -> RasterScene:
    """A few overlapping Gaussians on 2 x 2 tiles."""
    gaussians = gaussians_in((-1.2, -0.9, 1.5), (1.2, 0.9, 4), count, degree=2, scale=(-1.6, 0.4), seed=seed)
    return RasterScene(gaussians, cameras(views, 25, 19, focal=20.0))


def leaves(scene: RasterScene) -> tuple[Gaussians, Views, Tensor, Tensor]:
    """Gaussians, views that depend on a motion xi, xi and a background: all with gradients."""
    gaussians = scene.gaussians.map(lambda tensor: tensor.clone().requires_grad_())
    xi = torch.zeros(len(scene.views), 6, dtype=torch.float64, requires_grad=True)
    views = Views(
        exp_se3(xi) @ scene.views.cam_from_world, scene.views.intrinsics, scene.views.width, scene.views.height
    )
    return gaussians, views, xi, BACKGROUND.clone().requires_grad_()


def gradients(draw: object, scene: RasterScene, settings: RasterSettings) -> dict[str, Tensor]:
    """Of a sum of all images, each pixel with another weight."""
    assert callable(draw)
    gaussians, views, xi, background = leaves(scene)
    output: RenderOutput = draw(gaussians, views, settings, background)
    output.means2d.retain_grad()
    generator = torch.Generator().manual_seed(3)
    total = torch.zeros((), dtype=torch.float64)
    for name in ("colour", "alpha", "expected_depth", "normals", "distortion"):
        image = getattr(output, name)
        if image is not None:
            total = total + (image * torch.randn(image.shape, generator=generator, dtype=torch.float64)).sum()
    total.backward()
    found = {name: tensor.grad for name, tensor in gaussians.named()}
    found |= {"xi": xi.grad, "background": background.grad, "means2d": output.means2d.grad}
    return {name: gradient for name, gradient in found.items() if gradient is not None}


def assert_gradients_agree(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    assert found.keys() == expected.keys()
    assert {"xi", "background", "means2d", "sh"} <= found.keys()
    for name, gradient in expected.items():
        assert gradient.abs().max() > 0, name
        assert (found[name] - gradient).abs().max() <= tolerance * gradient.abs().max(), name


# ------------------------------------------------------------------------------------------------- what gsplat gets


def test_everything_is_handed_to_gsplat_in_its_units(twins: GsplatTwins) -> None:
    scene = small()
    settings = RasterSettings(sh_degree=1, near=0.25, backend="cuda")
    rasterize_cuda(scene.gaussians, scene.views, settings, BACKGROUND)
    (given,) = twins.calls
    expected = {
        "means": scene.gaussians.means,
        "quats": scene.gaussians.quaternions,
        "scales": scene.gaussians.log_scales.exp(),
        "opacities": torch.sigmoid(scene.gaussians.opacity_logits),
        "colors": scene.gaussians.sh,
        "viewmats": scene.views.cam_from_world,
        "Ks": scene.views.intrinsics,
        "backgrounds": BACKGROUND.expand(2, 3),
    }
    for name, tensor in expected.items():
        assert torch.equal(given.pop(name), tensor), name
    assert given == {
        "width": 25,
        "height": 19,
        "near_plane": 0.25,
        "eps2d": 0.3,
        "sh_degree": 1,
        "packed": False,
        "tile_size": 16,
        "render_mode": "RGB+ED",
        "rasterize_mode": "classic",
        "camera_model": "pinhole",
        "absgrad": False,
    }


def test_gsplat_knows_all_that_it_is_given() -> None:
    import inspect

    from gsplat import isect_offset_encode, isect_tiles, rasterization, rasterize_to_indices_in_range
    from gsplat import rasterize_to_indices_in_range_2dgs as listing_2d

    for name in (
        "eps2d",
        "near_plane",
        "backgrounds",
        "render_mode",
        "rasterize_mode",
        "camera_model",
        "tile_size",
    ):
        assert name in inspect.signature(rasterization).parameters
    assert list(inspect.signature(isect_tiles).parameters)[:6] == [
        *("means2d", "radii", "depths", "tile_size", "tile_width", "tile_height")
    ]
    assert list(inspect.signature(isect_offset_encode).parameters) == [
        *("isect_ids", "n_images", "tile_width", "tile_height")
    ]
    for listing, shape in ((rasterize_to_indices_in_range, "conics"), (listing_2d, "ray_transforms")):
        assert list(inspect.signature(listing).parameters) == [
            *("range_start", "range_end", "transmittances", "means2d", shape, "opacities"),
            *("image_width", "image_height", "tile_size", "isect_offsets", "flatten_ids"),
        ]


def test_all_stored_harmonics_are_used_unless_told_otherwise(twins: GsplatTwins) -> None:
    scene = small()
    rasterize_cuda(scene.gaussians, scene.views, RasterSettings(), BACKGROUND)
    assert twins.calls[0]["sh_degree"] == 2


def test_poses_and_background_are_brought_to_the_precision_of_the_gaussians(twins: GsplatTwins) -> None:
    scene = small()
    pose = scene.views.cam_from_world.clone().requires_grad_()
    views = Views(pose, scene.views.intrinsics, scene.views.width, scene.views.height)
    output = rasterize_cuda(scene.gaussians.to(dtype=torch.float32), views, RasterSettings(), BACKGROUND)
    assert {twins.calls[0][name].dtype for name in ("viewmats", "Ks", "backgrounds")} == {torch.float32}
    output.colour.sum().backward()
    assert pose.grad is not None
    assert pose.grad.dtype == torch.float64


def test_gsplats_projection_is_ours() -> None:
    """Float64 twin against float64 reference: only rounding may differ."""
    from gsplat.cuda import _torch_impl

    scene = SCENES["held Jacobians"]
    gaussians, views = scene.gaussians, scene.views
    seen = project(gaussians, views.cam_from_world[0], views.intrinsics[0], views, RasterSettings(near=scene.near))
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(gaussians.quaternions, gaussians.log_scales.exp())
    radii, means2d, depths, conics, _ = _torch_impl._fully_fused_projection(
        gaussians.means,
        covariances,
        views.cam_from_world,
        views.intrinsics,
        views.width,
        views.height,
        eps2d=0.3,
        near_plane=scene.near,
    )
    assert len(seen.index) > 50
    torch.testing.assert_close(means2d[0, seen.index], seen.means2d, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(depths[0, seen.index], seen.depths, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(conics[0, seen.index], seen.conics, rtol=1e-6, atol=1e-9)
    # The twin's boxes are for opaque Gaussians, ours for the opacity they have.
    assert (radii[0, seen.index].amax(-1) >= seen.radii).all()


# ------------------------------------------------------------------------------------------------- kind 3d


@pytest.mark.parametrize("name", ["three views, degree 2", "across the near plane", "smaller than a tile"])
def test_images_are_those_of_the_reference(twins: GsplatTwins, name: str) -> None:
    scene = SCENES[name]
    settings = RasterSettings(near=scene.near)
    found = rasterize_cuda(scene.gaussians, scene.views, settings, BACKGROUND)
    expected = rasterize_reference(scene.gaussians, scene.views, settings, BACKGROUND)
    decided = ~undecided_pixels(scene, expected.colour, 1e-9)
    for image in IMAGES:
        torch.testing.assert_close(
            getattr(found, image)[decided], getattr(expected, image)[decided], rtol=1e-6, atol=1e-8
        )
    drawn = expected.radii > 0
    assert found.radii.shape == drawn.shape
    assert found.radii.dtype == torch.int32
    assert (found.radii >= expected.radii).all()
    torch.testing.assert_close(found.means2d[drawn], expected.means2d[drawn])
    assert (found.means2d[found.radii == 0] == 0).all()
    assert found.normals is None
    assert found.distortion is None


def test_gradients_are_those_of_the_reference(twins: GsplatTwins) -> None:
    # The pose through the direction of the harmonics too: degree 2.
    scene, settings = small(), RasterSettings()
    expected = gradients(rasterize_reference, scene, settings)
    assert_gradients_agree(gradients(rasterize_cuda, scene, settings), expected, 1e-6)


def test_the_median_depth_is_found_across_batches(twins: GsplatTwins, monkeypatch: pytest.MonkeyPatch) -> None:
    # A tile of 2 x 2 pixels has batches of 4: the faint ones need many.
    monkeypatch.setattr(cuda, "TILE", 2)
    monkeypatch.setattr(cuda, "_BATCHES", 1)
    gaussians = gaussians_in((-0.5, -0.5, 2), (0.5, 0.5, 4), 60, scale=(-0.5, 0.1), logit=(-3.0, 1.0), seed=2)
    views = straight_view(9, 9.0)
    found = rasterize_cuda(gaussians, views, RasterSettings(), BACKGROUND)
    expected = rasterize_reference(gaussians, views, RasterSettings(), BACKGROUND)
    assert len(set(expected.median_depth.flatten().tolist())) > 5
    torch.testing.assert_close(found.median_depth, expected.median_depth)


# ------------------------------------------------------------------------------------------------- kind 2d


def test_disks_are_those_of_the_reference(twins: GsplatTwins) -> None:
    scene, settings = small(seed=4), RasterSettings(kind="2d")
    found = rasterize_cuda(scene.gaussians, scene.views, settings, BACKGROUND)
    expected = rasterize_reference_2d(scene.gaussians, scene.views, settings, BACKGROUND)
    assert expected.alpha.max() > 0.9
    for image in (*IMAGES, "normals", "distortion", "means2d"):
        torch.testing.assert_close(getattr(found, image), getattr(expected, image), rtol=1e-7, atol=1e-9)
    assert torch.equal(found.radii, expected.radii)
    assert twins.calls == []


def test_gradients_of_disks_are_those_of_the_reference(twins: GsplatTwins) -> None:
    scene, settings = small(seed=4, count=40, views=1), RasterSettings(kind="2d")
    expected = gradients(rasterize_reference_2d, scene, settings)
    assert_gradients_agree(gradients(rasterize_cuda, scene, settings), expected, 1e-6)


def test_without_disks_there_is_background(twins: GsplatTwins) -> None:
    behind = gaussians_in((-1, -1, -5), (1, 1, -3), 5)
    output = rasterize_cuda(behind, straight_view(), RasterSettings(kind="2d"), BACKGROUND)
    assert torch.equal(output.colour, BACKGROUND.expand(1, 21, 21, 3))
    for image in ("alpha", "expected_depth", "median_depth", "normals", "distortion", "radii"):
        assert not getattr(output, image).any()


# ------------------------------------------------------------------------------------------------- lists of pairs


def test_light_is_what_the_pairs_in_front_leave() -> None:
    pixel = torch.tensor([1, 1, 1, 3, 3])
    alpha = torch.tensor([0.5, 0.2, 0.9, 0.1, 0.6], dtype=torch.float64)
    before = transmittance_before(pixel, alpha, 5)
    torch.testing.assert_close(before, torch.tensor([1, 0.5, 0.4, 1, 0.9], dtype=torch.float64))
    torch.testing.assert_close(sums(pixel, alpha, 5), torch.tensor([0, 1.6, 0, 0.7, 0], dtype=torch.float64))
    # Half the light is left behind the first pair of pixel 1: that is the median; pixel 3 falls below at its last.
    seen, pair = median_pairs(pixel, alpha, before, 5)
    assert seen.tolist() == [1, 3]
    assert pair.tolist() == [0, 4]


# ------------------------------------------------------------------------------------------------- what is missing


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_what_to_do() -> None:
    scene = small()
    with pytest.raises(
        CapabilityError,
        match=r"Backend 'cuda' cannot draw here; expected an NVIDIA GPU .*; found PyTorch .* without a GPU.*"
        r"Use backend 'cpu', or install",
    ):
        rasterize(scene.gaussians, scene.views, RasterSettings(backend="cuda"))


def test_gaussians_elsewhere_are_not_moved_behind_the_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    scene = small()
    with pytest.raises(
        CapabilityError, match=r"Gaussians' means; expected float32 on a GPU; found float64 on cpu.*gaussians\.to\("
    ):
        rasterize_cuda(scene.gaussians, scene.views, RasterSettings(), BACKGROUND)


def test_without_kernels_the_cure_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = ModuleType("gsplat.cuda._backend")
    monkeypatch.setitem(sys.modules, backend.__name__, backend)
    backend._C = None
    with pytest.raises(
        CapabilityError, match=r"gsplat cannot draw here; expected its CUDA kernels; .*CUDA toolkit"
    ):
        cuda._require_kernels()
    backend._C = object()
    cuda._require_kernels()


def test_without_gsplat_the_cure_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    scene = small()
    with pytest.raises(MissingDependencyError, match=r"pip install 'sightline-toolkit\[cuda\]'"):
        rasterize_cuda(scene.gaussians, scene.views, RasterSettings(), BACKGROUND)


# -------------------------------------------------------------------------------------------- where there is a GPU


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
@pytest.mark.parametrize("kind", ["3d", "2d"])
@pytest.mark.parametrize("name", ["three views, degree 2", "ordinary, degree 3"])
def test_on_a_gpu_it_agrees_with_the_reference(name: str, kind: str) -> None:
    """Float32 with the fast exponential of the GPU: values to 1e-3, gradients to 1e-2 of the largest."""
    scene = SCENES[name]
    settings = RasterSettings(kind="2d" if kind == "2d" else "3d", near=scene.near)
    reference = rasterize_reference_2d if kind == "2d" else rasterize_reference

    def on_gpu(gaussians: Gaussians, views: Views, how: RasterSettings, background: Tensor) -> RenderOutput:
        return rasterize_cuda(gaussians.to(dtype=torch.float32, device="cuda"), views, how, background)

    found = on_gpu(scene.gaussians, scene.views, settings, BACKGROUND)
    expected = reference(scene.gaussians, scene.views, settings, BACKGROUND)
    for image in ("colour", "alpha", "expected_depth"):
        gap = (getattr(found, image).cpu().double() - getattr(expected, image)).abs()
        # A few pixels have a Gaussian at the limit of being drawn.
        assert (gap > 1e-3).float().mean() < 0.01, image
    made, wanted = gradients(_back(on_gpu), scene, settings), gradients(reference, scene, settings)
    assert_gradients_agree({name: gradient.cpu() for name, gradient in made.items()}, wanted, 1e-2)


def _back(draw: object) -> object:
    """Return ``draw`` with images in float64 on the CPU; ``means2d`` keeps its place in the graph."""
    import dataclasses

    def drawn(*arguments: object) -> RenderOutput:
        assert callable(draw)
        output: RenderOutput = draw(*arguments)
        names = ("colour", "alpha", "expected_depth", "normals", "distortion")
        images = {name: getattr(output, name) for name in names}
        moved = {name: image.cpu().double() for name, image in images.items() if image is not None}
        return dataclasses.replace(output, **moved)

    return drawn
