"""Figures of cameras on a circle show what was measured, and say what cannot be drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.circle import circle_angles_figure, circle_figure, circle_residuals_figure
from toolkit.scene import Frame, Scene


def scene(turn: float = 360.0, climb: float = 0.0, frames: int = 60) -> Scene:
    """Cameras around z over a turn, the last at its end, that climb in all by a part of the radius of 2."""
    angles = np.radians(np.linspace(0.0, turn, frames))
    height = 2 * climb * np.linspace(0.0, 1.0, frames)
    centres = np.column_stack([2 * np.cos(angles), 2 * np.sin(angles), height])
    poses = [RigidTransform.look_at(centre, [0.0, 0.0, centre[2]]) for centre in centres]
    named = tuple(Frame(f"{i:03d}.png", 1, pose) for i, pose in enumerate(poses))
    return Scene(Path(), {1: ColmapCamera.pinhole(64, 48, 50.0)}, named)


def traces(drawn: object, name: str) -> list[object]:
    return [trace for trace in drawn.data if trace.name is not None and trace.name.startswith(name)]


def test_the_circle_is_drawn_from_above_and_from_the_side_with_its_gap() -> None:
    drawn = circle_figure({"sequential": scene(300.0), "circular": scene()}, scene(), expected_turn=360.0)
    above, side = traces(drawn, "circular: 360.00")
    np.testing.assert_allclose(np.hypot(above.x, above.y), 1.0, atol=1e-6)
    np.testing.assert_allclose(side.y, 0.0, atol=1e-6)
    # 300 of 360 degrees: a chord of one radius of 2 pi radii, 15.9 %.
    assert "gap 16 %" in traces(drawn, "sequential")[0].name
    gaps = [trace for trace in drawn.data if trace.name is None]
    assert len(gaps) == 3
    lengths = [np.hypot(trace.x[1] - trace.x[0], trace.y[1] - trace.y[0]) for trace in gaps]
    np.testing.assert_allclose(lengths, [0.0, 1.0, 0.0], atol=1e-5)


def test_open_arcs_have_no_gap() -> None:
    drawn = circle_figure({"arc": scene(98.0)})
    assert "gap" not in traces(drawn, "arc")[0].name
    assert all(trace.name is not None for trace in drawn.data)


def test_angles_are_drawn_with_their_errors() -> None:
    drawn = circle_angles_figure({"found": scene(290.0)}, scene(98.0))
    angle, error = traces(drawn, "found")
    assert angle.y[-1] == pytest.approx(290.0, abs=1e-3)
    assert error.y[-1] - error.y[0] == pytest.approx(192.0, abs=1e-3)
    assert np.mean(error.y) == pytest.approx(0.0, abs=1e-9)
    assert len(traces(circle_angles_figure({"found": scene(290.0)}), "found")) == 1


def test_residuals_are_per_cent_of_the_radius() -> None:
    drawn = circle_residuals_figure({"spiral": scene(climb=0.2), "circle": scene()})
    outwards, along = traces(drawn, "spiral")
    assert np.ptp(along.y) > 2.0
    assert np.abs(outwards.y).max() < 2.0
    assert np.abs(traces(drawn, "circle")[1].y).max() < 1e-4


def test_what_is_no_circle_is_named_with_the_reason() -> None:
    line = scene()
    straight = tuple(
        Frame(f.name, 1, RigidTransform(np.eye(3), np.array([float(i), 0.0, 0.0])))
        for i, f in enumerate(line.frames)
    )
    found = {"line": line.replace(frames=straight), "circle": scene(), "none": line.without_poses()}
    for make in (circle_figure, circle_angles_figure, circle_residuals_figure):
        title = make(found, scene()).layout.title.text
        assert "line: The camera centres lie on a line" in title
        assert "none: Too few cameras" in title
        assert "circle:" not in title
