"""Inspection footage from the command line: made into a scene, masked by hand, cut into segments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.cli import main
from toolkit.poses.camera_profile import CameraProfile, write_profile
from toolkit.scene.folder import read_scene

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a moving wall, a stop, and a bright bar that stands still."""
    folder = tmp_path_factory.mktemp("cli") / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(0)
    wall = np.repeat(np.repeat(rng.integers(60, 180, (12, 200)), 8, axis=0), 8, axis=1)
    for i, place in enumerate([*range(0, 90, 3), *[90] * 20, *range(93, 180, 3)]):
        frame = wall[:, place : place + 128] + rng.normal(size=(96, 128))
        frame[:, :24] = 230
        Image.fromarray(np.clip(frame, 0, 255).astype(np.uint8)).save(folder / f"{i:03d}.png")
    return folder


def test_a_folder_becomes_a_scene_that_is_masked_by_hand_and_cut(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene"
    assert main(["inspection", str(pictures), str(scene), "--crop.width", "120", "--rate", "60"]) == 0
    said = capsys.readouterr()
    assert "120 x 96 px from (4, 0), " in said.out
    assert "left out frames 31 to 49: within 0." in said.out
    assert "of frame 30, which is kept" in said.out
    assert f"60 of 79 frames written to {scene}" in said.out
    assert "warning: the video has 30 frames a second, fewer than the 60 asked for" in said.err
    assert read_scene(scene).mask_dir == scene / "masks"

    mask = np.full((96, 120), 255, dtype=np.uint8)
    mask[:48] = 0
    Image.fromarray(mask).save(tmp_path / "painted.png")
    assert main(["mask", str(scene), "--mask", str(tmp_path / "painted.png")]) == 0
    assert "60 frames leave out 50.0 % of the picture" in capsys.readouterr().out

    assert main(["segment", str(scene), str(tmp_path / "part"), "--length", "10", "--start", "25"]) == 0
    assert "10 frames from frame_000025.jpg to frame_000053.jpg" in capsys.readouterr().out
    part = read_scene(tmp_path / "part")
    assert part.image_dir == scene / "images"
    assert part.mask_path(part.frames[0]) is not None

    Image.new("L", (120, 96), 255).save(scene / "mask.png")
    assert main(["mask", str(scene)]) == 0
    assert "white everywhere: the 60 frames have none now" in capsys.readouterr().out


def test_the_camera_of_a_profile_is_cropped_with_the_pictures(pictures: Path, tmp_path: Path) -> None:
    profile = CameraProfile(
        name="borescope",
        model="OPENCV_FISHEYE",
        width=256,
        height=192,
        params=(160.0, 160.0, 128.0, 96.0, 0.1, 0.0, 0.0, 0.0),
        focal_sigma=0.001,
        reprojection_error=0.5,
        photos=10,
        source="board",
        created="2026-06-01T10:00:00+00:00",
        seconds=10.0,
    )
    write_profile(profile, tmp_path / "profile.json")
    flags = ["--camera", str(tmp_path / "profile.json"), "--crop.rectangle", "28,6,90,80", "--rate", "0"]
    assert main(["inspection", str(pictures), str(tmp_path / "scene"), *flags]) == 0
    camera = read_scene(tmp_path / "scene").cameras[1]
    assert (camera.model, camera.width, camera.height) == ("OPENCV_FISHEYE", 90, 80)
    assert camera.params[:4] == pytest.approx((80.0, 80.0, 36.0, 42.0))


def test_errors_are_told_with_what_to_do(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = tmp_path / "still"
    still.mkdir()
    for i in range(20):
        (still / f"{i}.png").write_bytes((pictures / "000.png").read_bytes())
    assert main(["inspection", str(still), str(tmp_path / "a")]) == 2
    assert "error: Nothing moves in the video; expected" in capsys.readouterr().err
    Image.new("L", (128, 96), 0).save(tmp_path / "black.png")
    assert main(["inspection", str(pictures), str(tmp_path / "a"), "--mask", str(tmp_path / "black.png")]) == 2
    assert "black everywhere" in capsys.readouterr().err
    assert main(["inspection", str(pictures), str(tmp_path / "a"), "--stills.tolerance", "-1"]) == 2
    assert "Setting 'tolerance' is out of range" in capsys.readouterr().err
    assert main(["segment", str(tmp_path), str(tmp_path / "b"), "--length", "3"]) == 2
    assert "scene.json is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        ("inspection", ["--mask", "--camera", "--rate", "--crop.rectangle", "--static.grow", "--stills.remove"]),
        ("mask", ["--mask"]),
        ("segment", ["--length", "--start", "--stride", "--copy"]),
    ],
)
def test_the_help_names_the_flags(command: str, flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([command, "--help"])
    assert done.value.code == 0
    said = capsys.readouterr().out
    assert f"Example: toolkit {command}" in said
    assert [flag for flag in flags if flag not in said] == []
