"""How a viewer moves: the JavaScript of the navigation, run by node."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest

from toolkit.geometry.rigid import RigidTransform
from toolkit.widgets.viewer_files import FOLDER

LENS = {"fx": 400, "fy": 380, "cx": 330, "cy": 230, "width": 640, "height": 480}
# As far as the double precision of some rotations goes.
CLOSE = 1e-9


@pytest.fixture(scope="module")
def node() -> str:
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed: apt-get install nodejs")
    return found


@pytest.fixture
def camera() -> dict[str, Any]:
    """Return a camera 5 units south of the origin and 3 above it, looking at it."""
    position = np.array([0.0, -5.0, 3.0])
    world_from_cam = RigidTransform.look_at(position, np.zeros(3)).inverse()
    distance = float(np.linalg.norm(position))
    return {
        "position": position.tolist(),
        "rotation": world_from_cam.quaternion.tolist(),
        "distance": distance,
        "lens": LENS,
    }


def moved(node: str, camera: dict[str, Any], steps: str, result: str = "navigation.view") -> Any:
    """Return ``result`` after ``steps``, in which the viewer is ``navigation``."""
    program = f"""
        import {{ Navigation }} from {json.dumps((FOLDER / "src" / "navigation.js").as_uri())};
        import * as overlay from {json.dumps((FOLDER / "src" / "overlay.js").as_uri())};
        const camera = {json.dumps(camera)};
        const navigation = new Navigation([0, 0, 1], 10, camera);
        {steps}
        console.log(JSON.stringify({result}));
    """
    command = [node, "--input-type=module", "--eval", program]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def forward(view: dict[str, Any]) -> np.ndarray:
    return RigidTransform.from_quaternion(view["rotation"], np.zeros(3)).apply([0, 0, 1])


def target(view: dict[str, Any]) -> np.ndarray:
    return np.array(view["position"]) + view["distance"] * forward(view)


def test_an_orbit_keeps_the_target_and_the_horizon(node: str, camera: dict[str, Any]) -> None:
    view = moved(node, camera, "navigation.orbit(Math.PI / 2, 0); navigation.orbit(0, -0.2);")
    assert np.abs(target(view)).max() < CLOSE
    # A quarter to the left of the axis, seen from above: from the south to the east; lower pitch is a higher place.
    assert view["position"][0] > 0
    assert abs(view["position"][1]) < CLOSE
    assert view["position"][2] > 3
    right = RigidTransform.from_quaternion(view["rotation"], np.zeros(3)).apply([1, 0, 0])
    assert abs(right[2]) < CLOSE


def test_an_orbit_stops_before_the_zenith_and_turns_back(node: str, camera: dict[str, Any]) -> None:
    steps = "for (let i = 0; i < 50; i += 1) navigation.orbit(0.1, -0.2);"
    high = moved(node, camera, steps)
    assert -1 < forward(high)[2] < -0.9999
    assert np.abs(target(high)).max() < 1e-6
    back = moved(node, camera, steps + "navigation.orbit(0, 0.5);")
    assert forward(back)[2] == pytest.approx(-np.cos(0.5 + np.radians(0.5)), abs=1e-6)


def test_whoever_looks_straight_down_can_turn_away_from_there(node: str, camera: dict[str, Any]) -> None:
    down = RigidTransform.look_at((0, 0, 7), (0, 0, 0)).inverse()
    nadir = camera | {"position": [0, 0, 7], "rotation": down.quaternion.tolist(), "distance": 7}
    assert forward(moved(node, nadir, "navigation.orbit(0, -0.3);"))[2] == pytest.approx(-1)
    risen = moved(node, nadir, "navigation.orbit(0, 0.3);")
    assert forward(risen)[2] == pytest.approx(-np.cos(0.3))
    assert np.abs(target(risen)).max() < CLOSE


def test_shifting_nearing_and_walking(node: str, camera: dict[str, Any]) -> None:
    # A shift by one hundredth of the distance moves the target by four pixels of a lens of 400.
    shifted = moved(node, camera, "navigation.pan(0.01, 0);")
    assert target(shifted) == pytest.approx([0.01 * camera["distance"], 0, 0])
    near = moved(node, camera, "navigation.approach(0.5);")
    assert near["position"] == pytest.approx([0, -2.5, 1.5])
    assert np.abs(target(near)).max() < CLOSE
    through = moved(node, camera, "for (let i = 0; i < 60; i += 1) navigation.approach(0.8);")
    assert through["distance"] == pytest.approx(0.05)  # 0.005 of the radius
    # Each step pushes the target on by a fifth of that.
    assert 0.1 < target(through)[1] < 0.6
    walked = moved(node, camera, "navigation.move(0, 0, 2);")
    assert np.linalg.norm(walked["position"]) == pytest.approx(camera["distance"] - 2)


def test_the_horizon_is_levelled(node: str, camera: dict[str, Any]) -> None:
    roll = RigidTransform.from_quaternion([np.cos(1.5), 0, 0, np.sin(1.5)], np.zeros(3))  # 172 degrees
    world_from_cam = RigidTransform.from_quaternion(camera["rotation"], np.zeros(3)) @ roll
    rolled = camera | {"rotation": world_from_cam.quaternion.tolist()}
    view = moved(node, rolled, "navigation.level();")
    assert view["rotation"] == pytest.approx(camera["rotation"]) or view["rotation"] == pytest.approx(
        [-value for value in camera["rotation"]]
    )
    assert view["position"] == pytest.approx(camera["position"])


def test_a_flight_ends_where_it_should_and_begins_where_it_was(node: str, camera: dict[str, Any]) -> None:
    there = camera | {"position": [1, 2, 3], "rotation": [0, 1, 0, 0], "distance": 2, "lens": LENS | {"fx": 800}}
    for share, wanted in ((0, camera), (1, there)):
        view = moved(node, camera, f"navigation.standBetween(camera, {json.dumps(there)}, {share});")
        assert view["position"] == pytest.approx(wanted["position"])
        assert np.abs(forward(view) - forward(wanted)).max() < 1e-6
        assert view["lens"] == pytest.approx(wanted["lens"])
    middle = moved(node, camera, f"navigation.standBetween(camera, {json.dumps(there)}, 0.5);")
    assert np.linalg.norm(middle["rotation"]) == pytest.approx(1)
    assert middle["lens"]["fx"] == pytest.approx(600)


@pytest.mark.parametrize(("width", "height", "scale"), [(1280, 960, 2), (1280, 480, 1), (640, 960, 1)])
def test_the_cameras_picture_is_seen_whole(
    node: str, camera: dict[str, Any], width: int, height: int, scale: float
) -> None:
    seen = moved(node, camera, "", f"navigation.projection({width}, {height})")
    assert (seen["fx"], seen["fy"]) == (scale * 400, scale * 380)
    assert seen["cx"] == width / 2 + scale * 10
    assert seen["cy"] == height / 2 - scale * 10


def test_a_click_finds_the_nearest_camera_under_it(node: str, camera: dict[str, Any]) -> None:
    # Two cameras ahead, one behind the other, one aside, and the one in which the viewer stands.
    ahead = [camera | {"position": place, "use": "train"} for place in ([0, -2, 1.2], [0, 0, 0], [3, 0, 0])]
    scene = json.dumps({"cameras": [*ahead, camera | {"use": "test"}], "frustum": 0.4})
    centre = "[330, 230]"
    assert moved(node, camera, "", f"overlay.cameraAt({centre}, navigation, {scene}, 640, 480)") == 0
    assert moved(node, camera, "", f"overlay.cameraAt([40, 40], navigation, {scene}, 640, 480)") == -1
    pixel = 330 + 400 * 3 / camera["distance"]
    assert moved(node, camera, "", f"overlay.cameraAt([{pixel}, 230], navigation, {scene}, 640, 480)") == 2
