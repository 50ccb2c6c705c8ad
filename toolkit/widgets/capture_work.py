"""What the page does with a capture in a thread: open it, look at its photos, find its matches, draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.plots.base_map import base_map
from toolkit.plots.match_graph import match_map_figure
from toolkit.plots.matches import match_graph_figure
from toolkit.plots.photo_quality import sharpness_figure
from toolkit.plots.satellite import satellite_maps
from toolkit.plots.scene_map import scene_map
from toolkit.progress import Progress
from toolkit.runs.match_graph import MatchGraph, has_match_graphs, match_graphs
from toolkit.scene import Scene
from toolkit.scene.capture_paths import require_pictures_below
from toolkit.scene.capture_summary import SummaryRow, summary_rows, summary_warnings
from toolkit.scene.dataset import Capture, capture_fingerprint, open_capture
from toolkit.scene.photo_quality import blurred
from toolkit.scene.survey import PhotoFacts, evenly, read_facts, survey
from toolkit.scene.thumbnails import Thumbnail, Thumbnails, small_jpeg

#: Folder beside the runs in which thumbnails are kept.
THUMBNAILS = ".thumbnails"
#: Thumbnails that are shown.
MOST_PHOTOS = 60
_MAP_HEIGHT = 560
#: Longer side of the picture that a click shows, in pixels.
LARGE_SIDE = 1280


@dataclass(frozen=True, slots=True)
class OpenedCapture:
    """A capture with what its files say without decoding pictures.

    Attributes
    ----------
    path:
        Of its folder.
    capture, facts:
        As read.
    rows, warnings:
        For people.
    space, plane:
        Maps, None where nobody knows where the photos were taken.
    """

    path: Path
    capture: Capture
    facts: tuple[PhotoFacts, ...]
    rows: tuple[SummaryRow, ...]
    warnings: tuple[str, ...]
    space: go.Figure | None
    plane: go.Figure | None


@dataclass(frozen=True, slots=True)
class SurveyedPhotos:
    """What the pixels of a capture say.

    Attributes
    ----------
    soft:
        Places of the photos that may be blurred.
    warnings:
        All of the capture, those of its pixels too.
    figure:
        Sharpness of all photos.
    """

    soft: tuple[int, ...]
    warnings: tuple[str, ...]
    figure: go.Figure


def opened_capture(path: Path, roots: Sequence[Path], progress: Progress) -> OpenedCapture:
    """Open a capture. Raises :class:`DataError` where it cannot be, or shows files outside the data folders."""
    capture = require_pictures_below(open_capture(path, check=False, progress=progress), roots)
    facts = read_facts(capture.scene, progress=progress)
    space, plane = _maps(capture)
    return OpenedCapture(
        path,
        capture,
        facts,
        summary_rows(capture, facts),
        summary_warnings(capture, facts),
        space,
        plane,
    )


def shown_thumbnails(opened: OpenedCapture, kept: Thumbnails, progress: Progress) -> dict[int, Thumbnail]:
    """Return the thumbnails that the page shows, by the places of the photos: at most 60, evenly chosen."""
    chosen = evenly(len(opened.facts), MOST_PHOTOS)
    found = survey(opened.capture.scene, opened.facts, kept, chosen=chosen, progress=progress)
    return {place: picture for place, picture in found.items() if picture is not None}


def surveyed_photos(opened: OpenedCapture, kept: Thumbnails, progress: Progress) -> SurveyedPhotos:
    """Return the measures of all photos of a capture."""
    pictures = tuple(survey(opened.capture.scene, opened.facts, kept, progress=progress).values())
    kept.prune()
    values = [picture.sharpness if picture else None for picture in pictures]
    soft = tuple(blurred(values))
    figure = sharpness_figure([fact.name for fact in opened.facts], values, soft)
    warnings = summary_warnings(opened.capture, opened.facts, pictures)
    return SurveyedPhotos(soft, warnings, figure)


def found_matches(
    opened: OpenedCapture, runs_dir: Path, fingerprint: str, progress: Progress
) -> tuple[str, tuple[MatchGraph, ...]]:
    """Return the capture's fingerprint, found where it is not known yet, and its matchings, the newest first."""
    if not has_match_graphs(runs_dir):
        return fingerprint, ()
    scene = opened.capture.scene
    known = fingerprint or capture_fingerprint(scene, progress=progress)
    return known, match_graphs(runs_dir, known, len(scene))


def graph_map(opened: OpenedCapture, graph: MatchGraph) -> go.Figure:
    """Return a matching drawn where the photos were taken."""
    scene = opened.capture.scene
    reference = opened.capture.reference
    places, unit = _plan(reference if reference is not None else scene)
    if places is None and reference is not None:
        places, unit = _plan(scene)
    names = [frame.name for frame in scene.frames]
    return match_map_figure(names, places, graph.pairs, graph.inliers, unit)


def graph_matrix(opened: OpenedCapture, graph: MatchGraph) -> go.Figure:
    """Return a matching as a square of all photos against all; pairs that were not verified are blank."""
    drawn = match_graph_figure([frame.name for frame in opened.capture.scene.frames], graph.pairs, graph.inliers)
    drawn.update_layout(title_text=f"{len(graph.pairs):,} of {graph.tried:,} pairs verified")
    return drawn


def large_picture(opened: OpenedCapture, number: int) -> bytes:
    """Return a photo as JPEG for the page. Raises :class:`DataError` where it is damaged."""
    scene = opened.capture.scene
    if not 0 <= number < len(scene):
        raise DataError("There is no such photo", expected=f"one of {len(scene)}", found=str(number))
    return small_jpeg(scene.image_path(scene.frames[number]), LARGE_SIDE)


def _drawable(capture: Capture) -> tuple[Scene, Scene | None] | None:
    """Return the scene to draw, and the true one where it lies in the same world; None where nothing is known."""
    scene, reference = capture.scene, capture.reference
    placed = any(frame.prior is not None and frame.prior.position is not None for frame in scene.frames)
    if reference is not None and reference.registered:
        same = reference.georeference is not None and reference.georeference == scene.georeference
        return (scene.replace(points=reference.points), reference) if placed and same else (reference, None)
    return (scene, None) if placed else None


def _maps(capture: Capture) -> tuple[go.Figure | None, go.Figure | None]:
    """Return the map in space and that from above; of satellite pictures the sky, and outlines on the ground."""
    seen_from_orbit = satellite_maps(capture.scene)
    if seen_from_orbit is not None:
        return seen_from_orbit
    drawable = _drawable(capture)
    if drawable is None:
        return None, None
    scene, reference = drawable
    title = _map_title(capture)
    space = scene_map(scene, reference=reference)
    # The points are in the other map, whose drawing by WebGL is work enough for a browser without a graphics card.
    plane = base_map(scene, reference=reference, points=False)
    for figure in (space, plane):
        figure.update_layout(title_text=title, height=_MAP_HEIGHT)
    return space, plane


def _map_title(capture: Capture) -> str:
    frames = capture.scene.frames
    placed = sum(frame.prior is not None and frame.prior.position is not None for frame in frames)
    known = len(capture.reference.registered) if capture.reference is not None else 0
    parts = [f"{known} known poses"] if known else []
    parts += [f"{placed} sensor positions"] if placed else []
    return f"{len(frames)} photos, " + ", ".join(parts)


def _plan(scene: Scene) -> tuple[NDArray[np.float64] | None, str]:
    """Return where frames are from above (F, 2), NaN where unknown, and the unit; None where none is known."""
    places = np.full((len(scene), 2), np.nan)
    for row, frame in enumerate(scene.frames):
        if frame.cam_from_world is not None:
            places[row] = frame.cam_from_world.centre[:2]
        elif frame.prior is not None and frame.prior.position is not None:
            places[row] = frame.prior.position[:2]
    known = np.isfinite(places).any()
    return (places if known else None), ("m" if scene.georeference is not None else "")
