"""What each round of a search matched, as pictures."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ground_run import POSES, TESTS, make_ground_run

from toolkit.errors import DataError
from toolkit.localize.localizer import Localizer
from toolkit.localize.moved import Move
from toolkit.localize.query import query_of
from toolkit.localize.result import Localization
from toolkit.localize.settings import LocalizeSettings
from toolkit.localize.splat_map import SplatMap
from toolkit.localize.starts import Start
from toolkit.runs.localize_photo import run_scene
from toolkit.runs.round_pictures import answer_figure, round_figure, round_pictures, searches_figure
from toolkit.runs.run_map import open_run_map
from toolkit.scene import Scene

START = Move(east=8.0, north=-5.0, heading=10.0).applied_to(POSES[4])


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> tuple[SplatMap, Scene]:
    run = make_ground_run(tmp_path_factory.mktemp("ground"))
    return open_run_map(run), run_scene(run)


@pytest.fixture(scope="module")
def done(opened: tuple[SplatMap, Scene]) -> Localization:
    there, scene = opened
    ours = Localizer(there, LocalizeSettings().replace({"polish.use": False, "fan.most": 0}))
    found = ours.localize(query_of(scene, scene.frame(TESTS[0])), Start(TESTS[0], START, 10.0, 10.0))
    assert found
    return found


def test_each_round_shows_its_render_and_the_matches_seen_in_it(
    opened: tuple[SplatMap, Scene], done: Localization
) -> None:
    there, scene = opened
    first, last = (round_pictures(there, scene, done, number) for number in (0, done.rounds))
    for seen, of_round in ((first, done.trail[0]), (last, done.trail[-1])):
        assert seen.photo.shape == seen.render.shape
        # Points at the very border may lie outside the one or the other picture.
        assert 0.9 * of_round.matches <= len(seen.inside) <= of_round.matches
    # From the start photo and render differ by what the start is off; from the answer they are nearly the same.
    inliers = first.inside
    apart = np.linalg.norm(first.photo_pixels - first.render_pixels, axis=1)[inliers]
    close = np.linalg.norm(last.photo_pixels - last.render_pixels, axis=1)[last.inside]
    assert np.median(apart) > 10 > 3.5 > np.median(close)
    grey = [np.abs(seen.photo.astype(float) - seen.render).mean() for seen in (first, last)]
    assert grey[1] < 0.3 * grey[0]


def test_the_title_says_how_far_it_was_and_what_came_of_it(
    opened: tuple[SplatMap, Scene], done: Localization
) -> None:
    there, scene = opened
    title = round_figure(there, scene, done, 0).layout.title.text
    assert title.startswith("start: 9.43 m off, then ")
    assert "matches" in title
    end = round_figure(there, scene, done, done.rounds, side=120).layout.title.text
    assert end.startswith(f"after round {done.rounds}, the answer: 0.0")
    assert "then" not in end
    assert round_figure(there, scene, done, 0, title="mine").layout.title.text.startswith("mine · ")


def test_a_search_without_an_answer_has_none_in_its_titles(
    opened: tuple[SplatMap, Scene], done: Localization
) -> None:
    there, scene = opened
    lost = dataclasses.replace(done, cam_from_world=None, reason="not alike")
    assert round_figure(there, scene, lost, done.rounds).layout.title.text.startswith(
        f"after round {done.rounds}: "
    )


def test_the_answer_is_drawn_in_turn_with_the_photo(opened: tuple[SplatMap, Scene], done: Localization) -> None:
    drawn = answer_figure(*opened, done)
    assert [trace.type for trace in drawn.data] == ["image"] * 3
    assert drawn.layout.title.text.startswith(f"{TESTS[0]}, after round {done.rounds}, the answer: ")


def test_searches_are_lines_from_the_start_to_the_end(opened: tuple[SplatMap, Scene], done: Localization) -> None:
    _, scene = opened
    (line,) = searches_figure(scene, {"ours": done}, title="way").data
    assert len(line.y) == done.rounds + 1
    assert line.y[0] == pytest.approx(89**0.5)
    assert line.y[-1] < 0.05
    with pytest.raises(DataError, match=r"Photo 'photo_4.png' has no pose of its own"):
        searches_figure(scene.without_poses(), {"ours": done})


def test_a_pose_that_is_not_in_the_search_is_told(opened: tuple[SplatMap, Scene], done: Localization) -> None:
    with pytest.raises(DataError, match=r"The search for 'photo_4.png' has no pose 9; expected 0 to \d; found 9"):
        round_pictures(*opened, done, 9)
    with pytest.raises(DataError, match="has no pose -1"):
        round_pictures(*opened, done, -1)
