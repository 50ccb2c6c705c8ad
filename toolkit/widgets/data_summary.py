"""One capture: what is known of it, where its photos were taken, how they look, and which of them match."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import panel as pn

from toolkit.progress import Progress
from toolkit.runs.launch import WORKSPACE
from toolkit.runs.markup import Content, element
from toolkit.runs.match_graph import MatchGraph
from toolkit.runs.report_html import warning_list
from toolkit.scene.thumbnails import Thumbnail, Thumbnails, jpeg_url
from toolkit.widgets.capture_work import (
    THUMBNAILS,
    OpenedCapture,
    SurveyedPhotos,
    found_matches,
    graph_map,
    graph_matrix,
    large_picture,
    opened_capture,
    shown_thumbnails,
    surveyed_photos,
)
from toolkit.widgets.photo_grid import PhotoGrid
from toolkit.widgets.photo_tags import tags_table
from toolkit.widgets.style import SHEETS, html_pane, notes, plot_pane, show_figure, show_html
from toolkit.widgets.task import Task

_VARIES = element("span", "varies", class_="badge")
_LARGE_STYLE = "flex:2 1 480px;min-width:0;max-width:100%;border-radius:8px"
_FACTS_SHEET = """
.facts { display: grid; gap: 12px 26px; grid-template-columns: repeat(auto-fill, minmax(min(230px, 100%), 1fr)); }
.facts { padding: 14px 18px; margin: 12px 0 0; }
.facts dt { font-size: 12px; color: var(--muted); }
.facts dd { margin: 0; overflow-wrap: anywhere; }
.facts .badge { margin-left: 6px; font-weight: 500; }
"""


class CaptureView(pn.viewable.Viewer):
    """Shows one capture after the other. Everything that takes time is done in threads.

    Parameters
    ----------
    runs_dir:
        Folder of the runs, for thumbnails and matches.
    data_dirs:
        A capture that refers to pictures elsewhere is refused.
    dark:
        Whether the ground is dark.
    """

    def __init__(self, runs_dir: Path, data_dirs: Sequence[Path], *, dark: bool = False) -> None:
        super().__init__()
        self._runs_dir, self._data_dirs, self._dark = runs_dir, tuple(data_dirs), dark
        self._thumbnails = Thumbnails(runs_dir / THUMBNAILS)
        self.opened: OpenedCapture | None = None
        self._pictures: dict[int, Thumbnail] = {}
        self._fingerprint = ""
        self._graphs: tuple[MatchGraph, ...] = ()
        self._workspace: int | None = None
        self.opening, self.looking, self.matching, self.enlarging = Task(), Task(), Task(), Task()
        self._head, self._warnings, self._facts = html_pane(), html_pane(), html_pane()
        self._facts.stylesheets = [*SHEETS, _FACTS_SHEET]
        self._space, self._plane, self._sharpness = plot_pane(), plot_pane(), plot_pane()
        self._map_note, self._count, self._large = html_pane(), html_pane(), html_pane()
        self.grid = PhotoGrid()
        self.grid.param.watch(lambda event: self._enlarge(event.new), "chosen")
        self._graph = pn.widgets.Select(
            label="Matching", options={}, sizing_mode="stretch_width", max_width=440, margin=(0, 0, 8, 0)
        )
        self._graph.param.watch(lambda event: self._show_graph(), "value")
        self._graph_map, self._graph_matrix, self._graph_note = plot_pane(), plot_pane(), html_pane()
        self._layout = self._arranged()
        self._clear()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All that may work."""
        return self.opening, self.looking, self.matching, self.enlarging

    @property
    def graphs(self) -> tuple[MatchGraph, ...]:
        """The matchings of the capture that is shown."""
        return self._graphs

    def display(self, path: Path | None) -> None:
        """Show the capture in a folder, or none. What worked for another one ends."""
        for task in self.tasks:
            task.drop()
        self._clear()
        if path is None:
            return
        roots = self._data_dirs

        def work(progress: Progress) -> OpenedCapture:
            return opened_capture(path, roots, progress)

        self.opening.begin(f"Opening {path.name}", work, self._take_opened)

    def refresh(self) -> None:
        """Look for matches again where stages came or went; look at what works."""
        for task in self.tasks:
            task.look()
        if self.opened is not None and not self.matching.busy and self._stamp() != self._workspace:
            self._find_matches()

    def _take_opened(self, opened: OpenedCapture) -> None:
        self.opened = opened
        self._summary.visible = True
        show_html(self._head, element("h2", opened.path.name), notes([str(opened.path)]))
        show_html(self._warnings, warning_list(opened.warnings))
        show_html(self._facts, _fact_list(opened))
        show_figure(self._space, opened.space, dark=self._dark)
        show_figure(self._plane, opened.plane, dark=self._dark)
        unknown = "Nobody knows where the photos were taken: there are neither GPS positions nor poses."
        show_html(self._map_note, notes([unknown]) if opened.space is None else None)
        kept = self._thumbnails

        def work(progress: Progress) -> dict[int, Thumbnail]:
            return shown_thumbnails(opened, kept, progress)

        self.looking.begin("Looking at the photos", work, self._take_thumbnails)
        self._find_matches()

    def _take_thumbnails(self, pictures: dict[int, Thumbnail]) -> None:
        """Show the grid, then measure all photos; what was decoded for the grid is not decoded again."""
        opened, kept = self.opened, self._thumbnails
        if opened is None:
            return
        self._pictures, total = pictures, len(opened.facts)
        count = f"{len(pictures)} of {total}, evenly chosen. " if len(pictures) < total else ""
        show_html(self._count, notes([f"{count}Press one to see it larger, with its tags."]))
        self._fill_grid(frozenset())
        self._photos.visible = True

        def work(progress: Progress) -> SurveyedPhotos:
            return surveyed_photos(opened, kept, progress)

        self.looking.begin("Measuring sharpness and exposure", work, self._take_survey)

    def _take_survey(self, surveyed: SurveyedPhotos) -> None:
        show_html(self._warnings, warning_list(surveyed.warnings))
        show_figure(self._sharpness, surveyed.figure, dark=self._dark)
        if surveyed.soft:
            self._fill_grid(frozenset(surveyed.soft))

    def _fill_grid(self, soft: frozenset[int]) -> None:
        if self.opened is not None:
            facts = self.opened.facts
            shown = [
                (place, facts[place].name, picture.url, place in soft) for place, picture in self._pictures.items()
            ]
            self.grid.fill(shown)

    def _find_matches(self) -> None:
        opened, runs_dir, fingerprint = self.opened, self._runs_dir, self._fingerprint
        if opened is None:
            return
        self._workspace = self._stamp()

        def work(progress: Progress) -> tuple[str, tuple[MatchGraph, ...]]:
            return found_matches(opened, runs_dir, fingerprint, progress)

        self.matching.begin("Looking for matches", work, self._take_matches)

    def _take_matches(self, found: tuple[str, tuple[MatchGraph, ...]]) -> None:
        before = [graph.key for graph in self._graphs]
        self._fingerprint, self._graphs = found
        if [graph.key for graph in self._graphs] == before:
            return
        options = {graph.label: graph.key for graph in self._graphs}
        kept = self._graph.value if self._graph.value in options.values() else next(iter(options.values()), None)
        self._graph.param.update(options=options, value=kept)
        self._matches.visible = bool(self._graphs)
        self._show_graph()

    def _show_graph(self) -> None:
        graph = next((graph for graph in self._graphs if graph.key == self._graph.value), None)
        if graph is None or self.opened is None:
            return
        show_figure(self._graph_map, graph_map(self.opened, graph), dark=self._dark)
        show_figure(self._graph_matrix, graph_matrix(self.opened, graph), dark=self._dark)
        many = len(graph.groups) > 1
        sizes = ", ".join(str(size) for size in graph.groups[:6]) + (", ..." if len(graph.groups) > 6 else "")
        text = (
            f"Verified pairs connect {len(graph.groups)} groups of {sizes} photos: no single model holds them all."
        )
        show_html(self._graph_note, warning_list([text]) if many else notes(["Verified pairs connect all photos."]))

    def _enlarge(self, number: int) -> None:
        opened = self.opened
        if opened is None or number < 0:
            self.enlarging.drop()
            show_html(self._large)
            return
        if number >= len(opened.facts):
            return

        def take(jpeg: bytes) -> None:
            show_html(self._large, _large_card(opened, number, jpeg))

        self.enlarging.begin(
            f"Reading {opened.facts[number].name}", lambda told: large_picture(opened, number), take
        )

    def _stamp(self) -> int | None:
        """Return when a stage last came or went."""
        try:
            return (self._runs_dir / WORKSPACE).stat().st_mtime_ns
        except OSError:
            return None

    def _clear(self) -> None:
        self.opened, self._pictures, self._fingerprint, self._graphs = None, {}, "", ()
        for section in (self._summary, self._photos, self._matches):
            section.visible = False
        for pane in (
            self._head,
            self._warnings,
            self._facts,
            self._map_note,
            self._count,
            self._large,
            self._graph_note,
        ):
            show_html(pane)
        for plot in (self._space, self._plane, self._sharpness, self._graph_map, self._graph_matrix):
            show_figure(plot, None, dark=self._dark)
        self.grid.fill([])

    def _arranged(self) -> pn.Column:
        maps = pn.FlexBox(
            _half(self._space), _half(self._plane), gap="14px", sizing_mode="stretch_width", margin=(14, 0, 0, 0)
        )
        self._summary = _column(self._head, self._warnings, self._facts, self._map_note, maps)
        self._photos = _column(
            html_pane(element("h2", "Photos")),
            self._count,
            self.grid,
            self.enlarging,
            self._large,
            pn.Spacer(height=14),
            self._sharpness,
        )
        graphs = pn.FlexBox(
            _half(self._graph_map), _half(self._graph_matrix), gap="14px", sizing_mode="stretch_width", margin=0
        )
        self._matches = _column(html_pane(element("h2", "Matches")), self._graph, self._graph_note, graphs)
        return _column(self.opening, self._summary, self.looking, self._photos, self.matching, self._matches)


def _fact_list(opened: OpenedCapture) -> Content:
    facts = [
        element("div", element("dt", row.title), element("dd", row.text, _VARIES if row.varies else None))
        for row in opened.rows
    ]
    return element("dl", facts, class_="facts card")


def _large_card(opened: OpenedCapture, number: int, jpeg: bytes) -> Content:
    fact = opened.facts[number]
    frame = opened.capture.scene.frames[number]
    return element(
        "article",
        element("h3", fact.name),
        element(
            "div",
            element("img", src=jpeg_url(jpeg), alt=f"Photo {fact.name}", style=_LARGE_STYLE),
            element("div", tags_table(fact, frame), style="flex:1 1 280px;min-width:0"),
            style="display:flex;flex-wrap:wrap;gap:14px;align-items:flex-start;margin-top:8px",
        ),
        class_="card view",
        style="margin-top:12px",
    )


def _column(*parts: pn.viewable.Viewable | pn.viewable.Viewer) -> pn.Column:
    return pn.Column(*parts, sizing_mode="stretch_width", margin=0)


def _half(content: pn.viewable.Viewable) -> pn.Column:
    """Return a column that shares its row where there is room for two."""
    return pn.Column(
        content, sizing_mode="stretch_width", margin=0, styles={"flex": "1 1 min(420px, 100%)", "min-width": "0"}
    )
