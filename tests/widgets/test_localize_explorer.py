"""The explorer of a search for a pose: drag, look, localise, go from round to round; errors are told."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.errors import DataError
from toolkit.localize.localizer import Localizer
from toolkit.localize.moved import Move
from toolkit.localize.one_shot import OneShot
from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.localize.splat_map import SplatMap
from toolkit.scene import Frame, Scene
from toolkit.widgets.localize_explorer import LocalizeExplorer

pytest.importorskip("ipywidgets", reason="ipywidgets is not installed: pip install 'sightline-toolkit[ui]'")

ONCE = OneShotSettings().replace({"match.method": "sift"})
OURS = LocalizeSettings().replace({"polish.use": False, "fan.most": 2})


@pytest.fixture(scope="module")
def ground() -> SplatMap:
    return ground_map()


@pytest.fixture(scope="module")
def scene(ground: SplatMap, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return a map photo and three queries: one as it is, one black, one whose file is gone."""
    folder = tmp_path_factory.mktemp("flight")
    frames = []
    for number, split in enumerate(("train", "test", "test", "test")):
        pose = down(4.0 * number - 6.0, 1.0)
        frames.append(Frame(f"{number}.png", 1, pose, split=split))
        picture = photo(ground, pose).picture * (number != 2)
        Image.fromarray(picture.astype(np.uint8)).save(folder / f"{number}.png")
    (folder / "3.png").unlink()
    return Scene(image_dir=folder, cameras={1: CAMERA}, frames=tuple(frames))


@pytest.fixture
def explorer(ground: SplatMap, scene: Scene) -> LocalizeExplorer:
    return LocalizeExplorer(ground, scene, [Localizer(ground, OURS), OneShot(ground, ONCE)])


def title(explorer: LocalizeExplorer) -> str:
    return str(explorer.pictures.layout.title.text)


def test_queries_and_methods_are_offered_and_the_render_follows_the_sliders(explorer: LocalizeExplorer) -> None:
    assert explorer.photo.options == ("1.png", "2.png", "3.png")
    assert explorer.method.options == ("ours", "one-shot-sift")
    assert title(explorer) == "start: 0.0 m and 0.0° off"
    photo_before, render_before = (trace.source for trace in explorer.pictures.data)
    explorer.sliders["east"].value = 3.0
    explorer.sliders["north"].value = 4.0
    assert title(explorer) == "start: 5.0 m and 0.0° off"
    photo_after, render_after = (trace.source for trace in explorer.pictures.data)
    assert photo_after == photo_before
    assert render_after != render_before
    np.testing.assert_allclose(explorer.trail.data[-1].x, [down(-2.0, 1.0).centre[0] + 3.0])
    explorer.sliders["heading"].value = 10.0
    explorer.sliders["tilt"].value = 0.0
    assert title(explorer) == "start: 5.0 m and 10.0° off"
    assert explorer.round.disabled


def test_ours_converges_and_every_round_can_be_seen(explorer: LocalizeExplorer) -> None:
    explorer.place(Move(east=9.0, north=-6.0, heading=12.0))
    explorer.localise.click()
    assert explorer.done is not None
    assert explorer.done
    assert not explorer.localise.disabled
    assert explorer.message.value.startswith("<div")
    assert "Found: 0.0" in explorer.message.value  # the photo is the map's own render: centimetres are left
    assert explorer.round.max == explorer.done.rounds == explorer.round.value
    assert "the answer: 0.0" in title(explorer)
    assert len(explorer.trail.data[-1].x) == explorer.done.rounds + 1
    explorer.round.value = 0
    assert title(explorer).startswith("start: 10.82 m off")
    assert [trace.name for trace in explorer.pictures.data if trace.type == "scatter"] == [
        "outliers",
        "inliers of PnP",
    ]
    explorer.round.value = 1
    assert title(explorer).startswith("after round 1: ")
    assert explorer._play.value == 1


def test_one_shot_goes_one_round(explorer: LocalizeExplorer) -> None:
    explorer.method.value = "one-shot-sift"
    explorer.sliders["east"].value = 5.0
    explorer.localise.click()
    assert explorer.done is not None
    assert explorer.done.rounds == explorer.round.max == 1


def test_another_start_forgets_what_was_found(explorer: LocalizeExplorer) -> None:
    explorer.localise.click()
    assert explorer.done is not None
    explorer.sliders["up"].value = 2.0
    assert explorer.done is None
    assert explorer.round.max == 0
    assert title(explorer) == "start: 2.0 m and 0.0° off"
    explorer.back.click()
    assert explorer.move == Move()


def test_a_photo_that_is_not_found_is_told_with_the_reason(explorer: LocalizeExplorer) -> None:
    explorer.photo.value = "2.png"
    explorer.localise.click()
    assert explorer.done is not None
    assert not explorer.done
    assert "Not found: 0 of 0 matches agree, 30 are needed" in explorer.message.value
    assert title(explorer).startswith("after round" if explorer.round.value else "start")
    explorer.photo.value = "1.png"
    explorer.localise.click()
    assert "Found" in explorer.message.value


def test_a_photo_that_is_gone_is_told_and_the_next_one_works(explorer: LocalizeExplorer) -> None:
    explorer.photo.value = "3.png"
    assert "3.png" in explorer.message.value
    assert explorer.pictures.data == ()
    explorer.localise.click()
    assert "3.png" in explorer.message.value
    assert not explorer.localise.disabled
    assert explorer.done is None
    explorer.photo.value = "1.png"
    explorer.localise.click()
    assert "Found" in explorer.message.value


def test_a_start_outside_the_map_shows_nothing_and_fails_nowhere(explorer: LocalizeExplorer) -> None:
    explorer.sliders["tilt"].value = 45.0
    explorer.sliders["heading"].value = 180.0
    explorer.sliders["east"].value = 40.0
    explorer.sliders["north"].value = 40.0
    explorer.localise.click()
    assert explorer.done is not None
    assert "ound: " in explorer.message.value


def test_without_queries_map_photos_are_offered_and_without_poses_nothing(ground: SplatMap, scene: Scene) -> None:
    ours = Localizer(ground, OURS)
    mapped = scene.replace(frames=scene.frames[:1])
    assert LocalizeExplorer(ground, mapped, [ours]).photo.options == ("0.png",)
    with pytest.raises(DataError, match=r"No photo of the scene has a pose; .*found 0"):
        LocalizeExplorer(ground, scene.without_poses(), [ours])
    with pytest.raises(DataError, match="Nothing localises; expected at least one method"):
        LocalizeExplorer(ground, scene, [])


def test_it_shows_itself_in_a_cell(explorer: LocalizeExplorer) -> None:
    shown = explorer._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in shown
