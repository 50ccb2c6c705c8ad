"""Views chosen by hand: buttons, rays, and what they reach of the largest determinant."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Scene
from toolkit.views.fisher import select_views
from toolkit.widgets.view_choice import ViewChoice

pytest.importorskip("ipywidgets", reason="notebook widgets need ipywidgets (extra 'ui')")
pytest.importorskip("anywidget", reason="figures that change need anywidget (extra 'ui')")


def around(count: int) -> Scene:
    """Return cameras on a circle that look down to its middle, some farther aside than others."""
    frames = []
    for number in range(count):
        turn, aside = 2 * np.pi * number / count, np.radians(15 + 3 * number)
        place = 100 * np.array([np.sin(aside) * np.sin(turn), np.sin(aside) * np.cos(turn), np.cos(aside)])
        frames.append(Frame(f"view_{number}.png", 1, RigidTransform.look_at(place, (0, 0, 0))))
    return Scene(Path("images"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, tuple(frames))


def title(choice: ViewChoice) -> str:
    return str(choice.figure.layout.title.text)


def labels(choice: ViewChoice, name: str) -> list[str]:
    (trace,) = [one for one in choice.figure.data if (one.name or "").startswith(name)]
    return list(trace.text)


def test_it_begins_with_views_that_hardly_spread() -> None:
    choice = ViewChoice(around(7), 4)
    assert len(choice.chosen) == 4
    least = select_views(choice.directions, 4, include=choice.chosen).determinant
    share = least / select_views(choice.directions, 4).determinant
    assert share < 0.5
    assert f"{share:.0%} of the largest for 4 views" in title(choice)
    assert labels(choice, "chosen") == [str(view) for view in choice.chosen]


def test_the_best_views_reach_all_of_it() -> None:
    choice = ViewChoice(around(7), 4)
    best = select_views(choice.directions, 4).chosen
    choice.choose(best)
    assert choice.chosen == tuple(sorted(best))
    assert "100% of the largest" in title(choice)
    assert sorted(labels(choice, "left out")) == sorted(str(n) for n in range(7) if n not in best)


def test_fewer_than_three_span_nothing_and_none_is_no_error() -> None:
    choice = ViewChoice(around(5), 3)
    choice.choose([0, 1])
    assert "the determinant is 0 for fewer than 3" in title(choice)
    choice.choose([])
    assert title(choice) == "No view is chosen"
    assert len(labels(choice, "left out")) == 5


def test_it_is_shown_with_its_figure_where_no_kernel_answers() -> None:
    shown = ViewChoice(around(5), 3)._repr_mimebundle_()["application/vnd.plotly.v1+json"]
    json.dumps(shown, allow_nan=False)


def test_a_view_that_there_is_not_is_refused() -> None:
    with pytest.raises(DataError, match=r"no such view; expected 0 to 4; found \[0, 5\]"):
        ViewChoice(around(5), 3).choose([5, 0])


def test_two_views_are_no_choice() -> None:
    with pytest.raises(DataError, match="Too few views to choose from; expected at least 3; found 2"):
        ViewChoice(around(2), 2)
