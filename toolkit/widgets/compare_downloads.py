"""The comparison and the list as files: CSV, LaTeX and a page that needs no network."""

from __future__ import annotations

import io
from collections.abc import Callable

import panel as pn

from toolkit.progress import silent
from toolkit.runs.compare import Comparison
from toolkit.runs.compare_export import comparison_csv, comparison_latex, list_csv
from toolkit.runs.report_html import report_page
from toolkit.widgets.compare_view import CompareView
from toolkit.widgets.run_table import RunTable

#: Most test pictures in the page, and their width in pixels.
_MOST_VIEWS, _WIDTH = 24, 720
_MARGIN = (0, 12, 8, 0)


class CompareDownloads(pn.viewable.Viewer):
    """Buttons that give what is shown to the browser as a file, written when it is asked for."""

    def __init__(self, table: RunTable, view: CompareView) -> None:
        super().__init__()
        self._view = view
        self.csv = self._button("Comparison as CSV", "comparison.csv", comparison_csv)
        self.latex = self._button("Comparison as LaTeX", "comparison.tex", comparison_latex)
        self.html = self._button("Comparison as HTML page", "comparison.html", _page)
        self.list = pn.widgets.FileDownload(
            callback=lambda: io.StringIO(list_csv([table.rows[run_id] for run_id in table.shown], table.columns)),
            filename="runs.csv",
            label="List as CSV",
            margin=_MARGIN,
        )
        self._of_choice = (self.csv, self.latex, self.html)
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        return pn.FlexBox(*self._of_choice, self.list, sizing_mode="stretch_width", margin=0)

    def refresh(self) -> None:
        """Offer the files of a comparison where there is one."""
        for button in self._of_choice:
            button.disabled = self._view.comparison is None

    def _button(self, label: str, filename: str, written: Callable[[Comparison], str]) -> pn.widgets.FileDownload:
        def content() -> io.StringIO:
            comparison = self._view.comparison
            return io.StringIO(written(comparison) if comparison is not None else "")

        return pn.widgets.FileDownload(callback=content, filename=filename, label=label, margin=_MARGIN)


def _page(comparison: Comparison) -> str:
    return report_page(comparison, _MOST_VIEWS, _WIDTH, silent)
