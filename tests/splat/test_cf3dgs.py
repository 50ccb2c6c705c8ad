"""CF-3DGS on a procedural flight: the trajectory is found, and where it is lost the result says so."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from town_flight import make_flight, photo_of, true_depth

from toolkit.errors import CapabilityError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.image import psnr
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.progress import ProgressEvent
from toolkit.scene import Scene
from toolkit.splat.cf3dgs import Cf3dgsResult, cf_3dgs, used_memory
from toolkit.splat.chain_settings import Cf3dgsSettings, LocalSettings
from toolkit.splat.evaluate import draw
from toolkit.splat.growing_map import GrowingMap
from toolkit.splat.images import load_photo
from toolkit.splat.local_gaussians import gaussians_from_depth
from toolkit.splat.train_settings import TrainSettings

QUICK = Cf3dgsSettings().replace(
    {
        "chain.local.steps": 35,
        "chain.pose.steps": 70,
        "train.steps": 60,
        "train.sh_degree": 1,
        "train.background": "black",
    }
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("cf3dgs") / "flight"
    scene = make_flight(folder)
    return folder, scene.replace(frames=scene.frames[:7])  # one test frame, six for training


def run(flight: tuple[Path, Scene], settings: Cf3dgsSettings = QUICK, **more) -> Cf3dgsResult:
    folder, scene = flight
    return cf_3dgs(scene, lambda frame: true_depth(folder, frame), settings, seed=0, **more)


@pytest.fixture(scope="module")
def found(flight: tuple[Path, Scene]) -> tuple[Cf3dgsResult, list[ProgressEvent]]:
    events: list[ProgressEvent] = []
    return run(flight, progress=events.append), events


def test_the_trajectory_is_near_the_truth(flight: tuple[Path, Scene], found) -> None:
    _, scene = flight
    result, _ = found
    posed = result.posed(scene)
    errors = trajectory_errors(posed, scene, "sim3")
    path = np.linalg.norm(np.diff(scene.centres(scene.of_split("train")), axis=0), axis=1).sum()
    assert path > 15
    # Steps are off by some hundredths of their 4 m each, and what was off before stays.
    assert errors.ate < 0.03 * path
    assert result.reason == ""
    assert result.notes == ()
    assert [frame.name for frame in posed.registered] == [f"frame_{i:04d}.jpg" for i in range(1, 7)]
    assert posed.frame("frame_0000.jpg").cam_from_world is None


def test_the_splat_looks_like_the_photos_from_the_found_poses(flight: tuple[Path, Scene], found) -> None:
    _, scene = flight
    result, _ = found
    posed = result.posed(scene)
    for frame in posed.of_split("train")[:3]:
        photo = load_photo(posed, frame, 1000)
        colours = photo.colours()
        drawn = draw(result.gaussians, photo, QUICK.train)
        covered = drawn.alpha[0] > 0.9
        assert covered.float().mean() > 0.6  # borders that came into view late are hardly there after so few steps
        flat = colours[covered].mean(dim=0).expand_as(colours)
        # Better than one colour for all, by 3.4 dB after so few steps; from wrong poses it is worse than that.
        assert psnr(drawn.colour[0].clamp(0, 1), colours, covered) > psnr(flat, colours, covered) + 2.5


def test_what_each_frame_cost_is_reported(found) -> None:
    result, events = found
    report = result.to_dict()
    assert json.loads(json.dumps(report)) == report
    assert report["registered"] == 6
    assert report["steps"] == QUICK.train.steps == result.steps
    assert set(report["seconds_by_part"]) == {"local", "pose", "map"}
    assert all(seconds > 0 for seconds in report["seconds_by_part"].values())
    for frame in report["frames"][1:]:
        assert frame["pose"]["found"]
        assert frame["gaussians"] > 0
        assert frame["memory_bytes"] is None or frame["memory_bytes"] > 1_000_000
    assert report["gaussians"] == len(result.gaussians) > 1000
    steps = [event.done for event in events if event.stage == "splat.cf3dgs"]
    assert steps == list(range(1, QUICK.train.steps + 1))


def test_a_frame_of_noise_is_where_the_trajectory_ends(flight: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, scene = flight
    shutil.copytree(folder, tmp_path / "flight")
    noisy = tmp_path / "flight" / "images" / "frame_0003.jpg"
    pixels = np.random.default_rng(0).integers(0, 256, (72, 96, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(noisy)
    settings = QUICK.replace({"train.steps": 6, "chain.pose.steps": 30, "chain.local.steps": 10})
    result = run((folder, replace(scene, image_dir=noisy.parent)), settings)
    known = {name: pose is not None for name, pose in result.poses.items()}
    assert known == {f"frame_{i:04d}.jpg": i < 3 for i in range(1, 7)}
    assert result.reason.startswith("frame 'frame_0003.jpg': not converged: the photometric loss is 0.")
    assert result.notes == (f"4 of 6 training frames have no pose: {result.reason}.",)
    assert [frame.name for frame in result.frames] == [f"frame_{i:04d}.jpg" for i in (1, 2, 3)]
    report = result.to_dict()
    assert report["poses"]["frame_0003.jpg"] is None
    assert report["frames"][2]["pose"]["found"] is False
    assert len(result.gaussians) > 0


def test_the_same_seed_gives_the_same_result(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    short = (folder, scene.replace(frames=scene.frames[:4]))
    settings = QUICK.replace(
        {
            "train.steps": 6,
            "chain.pose.steps": 10,
            "chain.pose.max_loss": 2.0,
            "chain.local.steps": 4,
            "grow": "fill",
        }
    )
    one, other = run(short, settings), run(short, settings)
    for name, pose in one.poses.items():
        same = other.poses[name]
        assert pose is not None
        assert same is not None
        np.testing.assert_array_equal(pose.matrix, same.matrix)
    assert all(
        torch.equal(a, b) for (_, a), (_, b) in zip(one.gaussians.named(), other.gaussians.named(), strict=True)
    )


def test_settings_that_it_has_not_are_refused(flight: tuple[Path, Scene]) -> None:
    asked = QUICK.replace({"train.refine_poses": True, "train.exposure": True})
    with pytest.raises(CapabilityError, match="CF-3DGS does not know train.refine_poses, train.exposure; expected"):
        run(flight, asked)


def test_own_gaussians_fill_what_is_empty_and_nothing_else(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    frame = scene.frames[3]
    photo = photo_of(scene, frame)
    local = gaussians_from_depth(photo, true_depth(folder, frame), LocalSettings())
    column = local.means[:, 0] / local.means[:, 2] * photo.camera.params[0] + photo.camera.params[2]
    left = local.map(lambda tensor: tensor[column < 48])
    settings = TrainSettings(sh_degree=1, background="black", densify_start=0.0)
    grown = GrowingMap(left, settings, 90.0, torch.Generator().manual_seed(0))
    grown.add(photo)
    grown.optimise(2, lambda step, loss: None)  # so that there are moments and statistics to keep
    taken = grown.fill(local, photo, RigidTransform.identity())
    # The left half is covered, but for its edge and the sky's.
    assert taken == pytest.approx(int((column >= 48).sum()), rel=0.1)
    assert len(grown.gaussians) == len(left) + taken
    with torch.no_grad():
        assert draw(grown.gaussians, photo, settings).alpha[0][40:, 60:].mean() > 0.8
    assert grown.fill(local, photo, RigidTransform.identity()) < 0.1 * taken
    grown.optimise(4, lambda step, loss: None)
    assert grown.step == 4


def test_a_full_map_takes_no_more(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    photo = photo_of(scene, scene.frames[3])
    local = gaussians_from_depth(photo, true_depth(folder, scene.frames[3]), LocalSettings())
    few = local.map(lambda tensor: tensor[:10])
    grown = GrowingMap(few, TrainSettings(max_gaussians=15), 90.0, torch.Generator().manual_seed(0))
    assert grown.fill(local, photo, RigidTransform.identity()) == 5


def test_memory_is_told_where_the_system_tells_it(tmp_path: Path) -> None:
    (tmp_path / "statm").write_text("1000 25 5 1 0 10 0\n")
    assert used_memory("cpu", tmp_path / "statm") == 25 * 4096
    assert used_memory("cpu", tmp_path / "nothing") is None
