"""A run's splat becomes a video or pictures by one command, or one sentence says why not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_recipe import RECIPE, FakeSettings, MakeRun
from numpy.typing import NDArray
from PIL import Image

from toolkit.cli import main
from toolkit.errors import CapabilityError, DataError, RunError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.render import RenderOptions, render_run
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.splat.gaussians import Gaussians

# What the fake recipe's cameras look at, from about 9 units.
MIDDLE = (2.0, 8.0, 0.0)


def with_splat(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
    """Return red and green balls around the middle, and one far away that can hardly be seen."""
    generator = torch.Generator().manual_seed(0)
    means = torch.tensor(MIDDLE) + torch.randn(21, 3, generator=generator)
    means[20] = 1000.0
    opacity = torch.full((21,), 4.0)
    opacity[20] = -4.0
    colours = torch.tensor([[1.7, -1.7, -1.7], [-1.7, 1.7, -1.7]]).repeat(11, 1)[:21]
    gaussians = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(21, 1), torch.full((21, 3), -1.0), opacity, colours[:, None]
    )
    result = RECIPE.run(data, settings, context)
    return dataclasses.replace(result, scene=result.scene.with_every_nth_as_test(3), gaussians=gaussians)


@pytest.fixture
def run(queued: MakeRun) -> RunFolder:
    made = queued(name="balls")
    execute(made, recipe=dataclasses.replace(RECIPE, run=with_splat))
    return made


def changed(run: RunFolder, change: Callable[[Scene], Scene]) -> RunFolder:
    write_scene(change(read_scene(run.scene_folder)), run.scene_folder)
    return run


def pictures(folder: Path) -> list[NDArray[np.uint8]]:
    return [np.asarray(Image.open(path)) for path in sorted(folder.iterdir())]


def test_a_video_by_the_command(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    to = tmp_path / "balls.mp4"
    arguments = ["--frames", "5", "--size", "41x30", "--fps", "10", "--runs", str(run.path.parent)]
    assert main(["render", "balls", "--to", str(to), *arguments]) == 0
    assert capsys.readouterr().out == f"Wrote 5 pictures of run {run.id} to {to}\n"
    with av.open(str(to)) as container:
        assert container.streams.video[0].average_rate == 10
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == 5 * [(30, 42, 3)]  # H.264 has even sides
    for frame in frames:
        assert frame.max() > 40  # something is seen in each
        assert np.abs(frame.astype(int) - frames[0]).max() > 20 or frame is frames[0]


@pytest.mark.parametrize(("path", "count"), [("turntable", 4), ("flythrough", 4), ("test", 2)])
def test_pictures_along_each_path(run: RunFolder, tmp_path: Path, path: str, count: int) -> None:
    arguments = ["--path", path, "--frames", "4", "--what", "depth", "--background", "white"]
    assert main(["render", str(run.path), "--to", str(tmp_path / "made"), *arguments]) == 0
    made = pictures(tmp_path / "made")
    assert [picture.shape for picture in made] == count * [(32, 48, 3)]
    for picture in made:
        drawn = (picture != 255).any(-1)
        # The balls are in the middle of what is seen, with nothing around them.
        rows, columns = np.nonzero(drawn)
        assert 0.02 < drawn.mean() < 0.8
        assert abs(rows.mean() - 16) < 8
        assert abs(columns.mean() - 24) < 8


def test_the_cameras_view_is_kept_and_cut_to_another_shape(run: RunFolder, tmp_path: Path) -> None:
    render_run(run, tmp_path / "plain", RenderOptions(path="test"))
    render_run(run, tmp_path / "double", RenderOptions(path="test", size=(96, 64)))
    render_run(run, tmp_path / "square", RenderOptions(path="test", size=(32, 32)))
    folders = (tmp_path / name for name in ("plain", "double", "square"))
    plain, double, square = (pictures(folder)[0].astype(float) for folder in folders)
    halved = double.reshape(32, 2, 48, 2, 3).mean(axis=(1, 3))
    assert np.abs(halved - plain).mean() < 5  # blurred by 0.3 square pixels of either size
    assert np.abs(square - plain[:, 8:40]).max() <= 1


def test_odd_pictures_are_told_apart_from_videos_by_their_name(run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"Cannot write a video of kind '\.GIF'; expected a name that ends in \.mp4"):
        render_run(run, tmp_path / "a.GIF")
    assert render_run(run, tmp_path / "v1.2", RenderOptions(frames=1, size=(8, 8))) == 1
    assert len(pictures(tmp_path / "v1.2")) == 1


def test_a_run_without_splat_says_so(finished: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = finished()
    assert main(["render", str(run.path), "--to", str(tmp_path / "a.mp4")]) == 2
    assert f"error: Run {run.id} has no splat; expected a finished run of a method that makes one" in (
        capsys.readouterr().err
    )
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--size", "0x20"], "size is out of range; expected 1 to 8192 pixels a side; found 0x20."),
        (["--size", "20x9000"], "size is out of range"),
        (["--size", "large"], "--size is no size in pixels; expected width and height as 1280x720; found 'large'."),
        (["--frames", "0"], "Too few frames; expected at least 1; found 0."),
        (["--frames", "1", "--path", "flythrough"], "Too few frames; expected at least 2; found 1."),
        (["--fps", "0"], "Frames per second are out of range; expected more than 0, at most 1000; found 0.0."),
    ],
)
def test_numbers_out_of_range_are_told(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    assert main(["render", str(run.path), "--to", str(tmp_path / "a.mp4"), *arguments]) == 2
    assert f"error: {said}" in capsys.readouterr().err
    assert not (tmp_path / "a.mp4").exists()


def test_unknown_words_are_wrong_usage_and_the_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (["--path", "spiral"], ["--what", "heat"], ["--device", "tpu"]):
        with pytest.raises(SystemExit) as done:
            main(["render", "latest", "--to", "x", *wrong])
        assert done.value.code == 2
        assert "invalid choice" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["render", "--help"])
    assert "Example: toolkit render" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("path", "spiral", "Unknown path 'spiral'; expected turntable or flythrough or test"),
        ("what", "heat", "Unknown what 'heat'; expected colour or depth"),
    ],
)
def test_unknown_options_are_refused(option: str, value: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        RenderOptions(**{option: value})


def test_scenes_without_the_path_are_told(run: RunFolder, tmp_path: Path) -> None:
    few = RenderOptions(path="test", frames=2)
    changed(run, lambda scene: scene.with_every_nth_as_test(0))
    with pytest.raises(DataError, match="no test pictures with a pose; expected at least one.*turntable or fly"):
        render_run(run, tmp_path / "a", few)
    changed(run, lambda scene: scene.replace(frames=scene.frames[:1]))
    with pytest.raises(StageError, match="no way to fly along"):
        render_run(run, tmp_path / "a", RenderOptions(path="flythrough", frames=2))
    changed(run, Scene.without_poses)
    with pytest.raises(DataError, match="The run's scene has no poses; expected registered frames"):
        render_run(run, tmp_path / "a", few)
    assert not (tmp_path / "a").exists()


def test_a_camera_with_distortion_is_drawn_without(run: RunFolder, tmp_path: Path) -> None:
    render_run(run, tmp_path / "plain", RenderOptions(path="test"))
    bent = ColmapCamera("OPENCV", 48, 32, (40.0, 40.0, 24.0, 16.0, 0.1, 0.0, 0.0, 0.0))
    changed(run, lambda scene: scene.replace(cameras={1: bent}))
    render_run(run, tmp_path / "bent", RenderOptions(path="test"))
    for one, other in zip(pictures(tmp_path / "plain"), pictures(tmp_path / "bent"), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("name", ["a.mp4", "a"])
def test_nothing_is_overwritten_and_a_stopped_render_leaves_nothing(
    run: RunFolder, tmp_path: Path, name: str
) -> None:
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")

    class Stop(CancelToken):
        def __call__(self, event: ProgressEvent) -> None:
            if event.done == 2:
                self.cancel()
            super().__call__(event)

    before = set(tmp_path.iterdir())
    with pytest.raises(Exception, match=r"Cancelled in stage splat\.render at 2 of 3"):
        render_run(run, tmp_path / name, RenderOptions(frames=3), progress=Stop())
    assert set(tmp_path.iterdir()) == before
    (tmp_path / name).write_text("mine")
    with pytest.raises(RunError, match="is there already; expected a new name"):
        render_run(run, tmp_path / name)
    assert (tmp_path / name).read_text() == "mine"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_nothing_else_is_taken(run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(CapabilityError, match="CUDA|GPU"):
        render_run(run, tmp_path / "a", RenderOptions(device="cuda", frames=1))
    assert not (tmp_path / "a").exists()
