"""What was matched in each round of a search for a pose, as pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from toolkit.errors import DataError
from toolkit.localize.result import Localization
from toolkit.localize.trail import trail_errors, trail_poses
from toolkit.plots.localization import convergence_figure
from toolkit.plots.localization_pictures import localization_matches_figure, render_against_query
from toolkit.runs.photo_results import MatchLines, StoredPose
from toolkit.runs.pose_pictures import SIDE, PosePictures, pose_pictures
from toolkit.scene import Scene

if TYPE_CHECKING:  # Plotly and PyTorch come with the first figure that is drawn.
    import plotly.graph_objects as go

    from toolkit.localize.splat_map import SplatMap


def round_pictures(
    splat_map: SplatMap, scene: Scene, done: Localization, number: int, *, side: int = SIDE
) -> PosePictures:
    """Return a photo and the map from one pose of the search, with the matches that led on from there.

    Parameters
    ----------
    splat_map, scene:
        In which the photo was localised; the photo is a frame of the scene.
    done:
        What came of it.
    number:
        Which pose of :func:`toolkit.localize.trail.trail_poses`: 0 is the start. At the last one there are no
        further matches; those of the last round are shown from there.
    side:
        Longer side of the pictures at most, in pixels.

    Raises
    ------
    DataError
        For a pose that there is not, and as :func:`toolkit.runs.pose_pictures.pose_pictures`.
    """
    poses = trail_poses(done)
    if not 0 <= number < len(poses):
        raise DataError(
            f"The search for '{done.name}' has no pose {number}",
            expected=f"0 to {len(poses) - 1}",
            found=f"{number}",
        )
    of_round = done.trail[min(number, done.rounds - 1)]
    lines = MatchLines(of_round.photo_pixels, of_round.points, of_round.inside, of_round.rendered_from)
    return pose_pictures(splat_map, scene, StoredPose(done.name, "", poses[number], lines=lines), side=side)


def round_figure(
    splat_map: SplatMap, scene: Scene, done: Localization, number: int, *, title: str = "", side: int = SIDE
) -> go.Figure:
    """Draw a photo beside the map from one pose of the search, and the matches that led on from there.

    Parameters and errors are those of :func:`round_pictures`.

    Parameters
    ----------
    title:
        What the title begins with; by default the place in the search, and how far the start or pose is from the
        one that the scene has.
    """
    seen = round_pictures(splat_map, scene, done, number, side=side)
    return localization_matches_figure(
        seen.photo,
        seen.render,
        seen.photo_pixels,
        seen.render_pixels,
        inlier=seen.inside,
        title=title or _place(done, number, seen),
    )


def answer_figure(splat_map: SplatMap, scene: Scene, done: Localization, *, side: int = SIDE) -> go.Figure:
    """Draw a photo beside the map from where its search ended, and both in turn, like the fields of a chessboard.

    Parameters and errors are those of :func:`round_pictures`.
    """
    last = len(trail_poses(done)) - 1
    seen = round_pictures(splat_map, scene, done, last, side=side)
    return render_against_query(
        seen.photo, seen.render, reliable=seen.reliable, title=f"{done.name}, {_place(done, last, seen)}"
    )


def searches_figure(scene: Scene, searches: Mapping[str, Localization], *, title: str = "") -> go.Figure:
    """Draw how far off the pose was from round to round, one line a search.

    Parameters
    ----------
    scene:
        Whose poses are the truth.
    searches:
        By label.

    Raises
    ------
    DataError
        For a photo that the scene has no pose for.
    """
    errors = {}
    for label, done in searches.items():
        truth = scene.frame(done.name).cam_from_world
        if truth is None:
            raise DataError(f"Photo '{done.name}' has no pose of its own", expected="one to measure errors from")
        errors[label] = trail_errors(done, truth)
    return convergence_figure(errors, title=title)


def _place(done: Localization, number: int, seen: PosePictures) -> str:
    """Return where in the search a pose is, how far from the truth, and how far the next one is."""
    poses = trail_poses(done)
    last = len(poses) - 1
    text = "start" if number == 0 else f"after round {number}" + (", the answer" if number == last and done else "")
    if seen.truth is None:
        return text
    here, *after = (np.linalg.norm(pose.centre - seen.truth.centre) for pose in poses[number : number + 2])
    return f"{text}: {here:.2f} m off" + "".join(f", then {next_:.2f} m" for next_ in after)
