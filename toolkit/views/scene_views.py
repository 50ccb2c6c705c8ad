"""View selection as a stage: a scene in, the same scene with fewer training views out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import SettingsError, StageError
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.views.directions import SceneViews, named_views, scene_views, with_views
from toolkit.views.fisher import ViewSelection, select_views
from toolkit.views.overlap import ViewOverlap, view_overlap, without_overlap
from toolkit.views.settings import ViewSelectionSettings


@dataclass(frozen=True, slots=True, eq=False)
class SceneSelection:
    """The views chosen from a scene.

    Attributes
    ----------
    selection:
        Indices into ``views``, and how well they spread.
    views:
        All views that could be chosen.
    scene:
        The scene with the chosen training frames and all test frames.
    overlap:
        How much of the stated box the views share, None where there was no box.
    apart:
        Views that were not chosen from, because they share too little of the box with others.
    """

    selection: ViewSelection
    views: SceneViews
    scene: Scene
    overlap: ViewOverlap | None = None
    apart: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the chosen frames in order of pick."""
        return tuple(self.views.names[index] for index in self.selection.chosen)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the views that could have been chosen and were not, in the scene's order."""
        return tuple(self.views.names[index] for index in self.selection.left_out)

    @property
    def reason(self) -> str:
        """Why these views, and how many frames could not be chosen from, for people to read."""
        counts = {
            "without pose": self.views.unposed,
            "that look away from the focus point": self.views.away,
            "without overlap": self.apart,
        }
        return "; ".join(
            [self.selection.reason, *(f"{len(who)} frames {why}" for why, who in counts.items() if who)]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return names, the selection and the views, ready for JSON."""
        return {
            "names": list(self.names),
            "left_out": list(self.left_out),
            "apart": list(self.apart),
            "reason": self.reason,
            "selection": self.selection.to_dict(),
            "views": self.views.to_dict(),
            "overlap": self.overlap.to_dict() if self.overlap is not None else None,
        }


def select_from_scene(
    scene: Scene,
    settings: ViewSelectionSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    focus: ArrayLike | None = None,
    box: ArrayLike | None = None,
) -> SceneSelection:
    """Choose ``settings.count`` of a scene's training views by the spread of their directions.

    Parameters
    ----------
    scene:
        With poses; cameras of any kind.
    seed:
        See :func:`toolkit.views.fisher.select_views`.
    focus:
        (3,) focus point in world coordinates; by default the setting ``focus`` says how it is found.
    box:
        (2, 3) lower and upper corner, in world coordinates, of a volume of which any two chosen views are to see
        ``settings.min_overlap`` per cent; by default overlap is not looked at.

    Raises
    ------
    DataError, SettingsError, StageError
        As :func:`toolkit.views.directions.scene_views`, :func:`toolkit.views.directions.named_views`,
        :func:`toolkit.views.fisher.select_views`, :func:`toolkit.views.overlap.view_overlap` and
        :func:`toolkit.views.overlap.without_overlap`; a StageError also where fewer views than asked for overlap.
    """
    progress(ProgressEvent("views.select", 0, 1, f"{settings.count} of {len(scene)} frames"))
    views = scene_views(scene, focus=focus, focus_by=settings.focus)
    include = named_views(scene, views, settings.include, must=True)
    exclude = set(named_views(scene, views, settings.exclude, must=False))
    overlap: ViewOverlap | None = None
    apart: tuple[str, ...] = ()
    if box is not None:
        overlap, apart = _apart(scene, views, settings, box, include, exclude)
        exclude |= {views.names.index(name) for name in apart}
    by_points = settings.method == "coverage" and settings.coverage_of == "points"
    selection = select_views(
        views.directions,
        settings.count,
        settings,
        include=include,
        exclude=sorted(exclude),
        covers=_covers(scene, views) if by_points else None,
        seed=seed,
    )
    chosen = [views.names[index] for index in selection.chosen]
    result = SceneSelection(selection, views, with_views(scene, chosen), overlap, apart)
    progress(ProgressEvent("views.select", 1, 1, result.reason))
    return result


def _apart(
    scene: Scene,
    views: SceneViews,
    settings: ViewSelectionSettings,
    box: ArrayLike,
    include: Sequence[int],
    exclude: set[int],
) -> tuple[ViewOverlap, tuple[str, ...]]:
    """Return the overlap of all views that are not excluded, and which of them share too little."""
    names = [name for index, name in enumerate(views.names) if index not in exclude]
    overlap = view_overlap(scene, names, box)
    must = [views.names[index] for index in include if index not in exclude]
    apart = without_overlap(overlap, settings.min_overlap / 100, must)
    if len(names) - len(apart) < settings.count:
        raise StageError(
            f"Too few views overlap to choose {settings.count}",
            expected=f"{settings.count} views of which any two see {settings.min_overlap:g} % of the box",
            found=f"{len(names) - len(apart)}, without {', '.join(apart)}" if apart else str(len(names)),
            todo="Lower count or min_overlap, or state another box",
        )
    return overlap, apart


def _covers(scene: Scene, views: SceneViews) -> NDArray[np.bool_]:
    """Return (n, P) which view has observed which point."""
    tracks = scene.points.tracks if scene.points is not None else None
    if scene.points is None or tracks is None:
        raise SettingsError(
            "Coverage of points needs to know which view sees which point",
            expected="a scene with points and tracks",
            found="none",
            todo="Set coverage_of to directions",
        )
    place = {name: index for index, name in enumerate(views.names)}
    row = np.array([place.get(frame.name, -1) for frame in scene.frames])[tracks.frame]
    covers = np.zeros((len(views), len(scene.points)), dtype=bool)
    covers[row[row >= 0], tracks.point[row >= 0]] = True
    return covers
