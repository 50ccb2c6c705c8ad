"""Photos of a scene, each from its own start, and what is told of all of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.localize.batch import localize_batch
from toolkit.localize.localizer import Localizer
from toolkit.localize.one_shot import OneShot
from toolkit.localize.query import query_of
from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.localize.starts import Start
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene

ONCE = OneShotSettings().replace({"match.method": "sift"})


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("flight")
    ground, frames = ground_map(), []
    for number in range(3):
        pose = down(4.0 * number, 1.0)
        frames.append(Frame(f"{number}.png", 1, pose))
        picture = photo(ground, pose).picture
        Image.fromarray(picture if number < 2 else picture * 0).save(folder / f"{number}.png")
    return Scene(image_dir=folder, cameras={1: CAMERA}, frames=tuple(frames))


def test_a_batch_tells_what_was_found_and_how_well(flight: Scene) -> None:
    ground = ground_map()
    starts = [Start(frame.name, down(4.0 * k + 3.0, 0.0), 5.0, 5.0) for k, frame in enumerate(flight.frames)]
    truth = flight.poses
    events: list[ProgressEvent] = []
    settings = LocalizeSettings().replace({"polish.use": False, "fan.most": 2})
    seen: list[str] = []
    batch = localize_batch(
        Localizer(ground, settings),
        flight,
        starts,
        progress=events.append,
        watch=lambda done: seen.append(done.name),
    )
    errors = batch.errors(truth)
    assert errors.found == 2
    assert errors.mte < 0.03  # the stillness asked for is 0.02 m
    assert batch.start_errors(truth).mte == pytest.approx(10**0.5)
    assert batch.median_seconds > 0
    assert seen == ["0.png", "1.png", "2.png"]
    assert events[-1].done == 3
    record = json.loads(json.dumps(batch.to_dict(), allow_nan=False))
    assert [row["found"] for row in record["queries"]] == [True, True, False]
    assert record["method"] == "ours"
    once = localize_batch(OneShot(ground, ONCE), flight, starts[:1])
    assert once.method == "one-shot-sift"
    assert once.found[0].rounds == 1


def test_no_start_is_an_error(flight: Scene) -> None:
    with pytest.raises(DataError, match="Nothing to localise"):
        localize_batch(OneShot(ground_map(), ONCE), flight, [])


def test_a_camera_of_another_kind_is_named(tmp_path: Path) -> None:
    scene = Scene(image_dir=tmp_path, cameras={1: AffineCamera(8, 8, 1, 0, 1, 4, 4)}, frames=(Frame("a.png", 1),))
    with pytest.raises(CapabilityError, match="cannot be localised"):
        query_of(scene, scene.frames[0])
