"""Executed notebooks as pages of the site: text, code, and the figures that they drew."""

from __future__ import annotations

import base64
import html
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from run_notebooks import executed_version

PLOTLY = "application/vnd.plotly.v1+json"
_WIDGET = "application/vnd.jupyter.widget-view+json"
_COLOUR_CODES = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
_BAR = re.compile(r"^[\w.]+: .*\[.*\]$")
_LOADS = re.compile(r"<script[^>]*\bsrc=|<link[^>]*\bhref=|https?://[^\s\"']+\.(?:js|css)", re.IGNORECASE)
#: What the page says of a notebook at its small size.
_SMALL = (
    "at the small size that tests use: figures are coarser and measures worse than those of a full run "
    "(`make notebooks`)"
)


@dataclass
class NotebookPage:
    """A page and what belongs to it.

    Attributes
    ----------
    text:
        Markdown with a mark in the place of each output that is HTML.
    outputs:
        That HTML by its mark.
    pictures:
        Bytes of picture files by their names beside the page.
    """

    text: str = ""
    outputs: dict[str, str] = field(default_factory=dict)
    pictures: dict[str, bytes] = field(default_factory=dict)

    @property
    def has_figures(self) -> bool:
        """Whether the page draws figures with Plotly."""
        return any("plotly-figure" in output for output in self.outputs.values())


def notebook_page(path: Path) -> NotebookPage:
    """Return the page of a notebook, with the outputs of its last execution where there is one."""
    found = executed_version(path)
    if found is None:
        from nbformat import read

        notebook, note = read(path, as_version=4), "Not executed yet: `make notebooks` executes it."
    else:
        notebook, note = found[0], _note(*found[1:])
    page, parts = NotebookPage(), []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        elif cell.cell_type == "code":
            parts.append(f"```py\n{cell.source}\n```")
            parts += [_output(output, path.stem, page) for output in _joined(cell.outputs)]
    # The first cell begins with the title; the note follows it.
    title, _, rest = parts[0].partition("\n")
    kept = f"{note} The notebook itself: [{path.name}]({path.name}), `make lab` opens it."
    page.text = "\n\n".join([title, f'!!! info "Executed notebook"\n    {kept}', rest, *parts[1:]])
    return page


def _note(size: str, record: dict[str, Any]) -> str:
    at = "at full size" if size == "full" else _SMALL
    machine = f"{record['machine']}, {record['cores']} cores"
    return f"Executed on {record['date']} in {record['seconds']:.0f} s ({machine}), {at}."


def _joined(outputs: list[Any]) -> list[Any]:
    """Return outputs with pieces of text that follow each other as one."""
    made: list[Any] = []
    for output in outputs:
        if made and output.output_type == made[-1].output_type == "stream" and output.name == made[-1].name:
            made[-1] = {**made[-1], "text": made[-1].text + output.text}
            made[-1] = type(output)(made[-1])
        else:
            made.append(output)
    return made


def _output(output: Any, stem: str, page: NotebookPage) -> str:
    """Return an output as Markdown: text as it is, HTML and figures as a mark."""
    if output.output_type == "stream":
        return _text(output.text)
    data = output.get("data", {})
    if PLOTLY in data:
        return _mark(page, stem, _figure(data[PLOTLY]))
    for kind, ending in (("image/png", "png"), ("image/jpeg", "jpg")):
        if kind in data:
            name = f"{stem}_{len(page.pictures)}.{ending}"
            page.pictures[name] = base64.b64decode(data[kind])
            return f"![Output of the cell]({name})"
    if _WIDGET in data:
        return "*An interactive piece, which only the running notebook shows.*"
    if "text/html" in data and not _LOADS.search(data["text/html"]):
        return _mark(page, stem, f'<div class="notebook-html">{data["text/html"]}</div>')
    if "text/markdown" in data:
        return str(data["text/markdown"])
    return _text(data["text/plain"]) if "text/plain" in data else ""


def _text(text: str) -> str:
    lines = [
        line.rsplit("\r", 1)[-1].rstrip() for line in _COLOUR_CODES.sub("", text).replace("\r\n", "\n").split("\n")
    ]
    # One empty line stays where there were some, but none after a progress bar.
    shown = "\n".join(
        line for i, line in enumerate(lines) if line or (i and lines[i - 1] and not _BAR.search(lines[i - 1]))
    ).strip("\n")
    return f"```{{ .text .notebook-text }}\n{shown}\n```" if shown else ""


def _mark(page: NotebookPage, stem: str, content: str) -> str:
    mark = f"OUTPUT-{stem}-{len(page.outputs)}-END"
    page.outputs[mark] = content
    return mark


def _figure(figure: dict[str, Any]) -> str:
    """Return a figure as a box with its data, which assets/figures.js draws when it comes into view."""
    data = json.dumps({key: figure[key] for key in ("data", "layout") if key in figure}, separators=(",", ":"))
    height = figure.get("layout", {}).get("height", 450)
    title = html.escape(str(figure.get("layout", {}).get("title", {}).get("text", "figure")))
    data = data.replace("</", r"<\/")
    inside = f'<script type="application/json">{data}</script>'
    return (
        f'<div class="plotly-figure" role="img" aria-label="{title}" style="min-height: {height}px">{inside}</div>'
    )


def with_outputs(page: str, outputs: dict[str, str]) -> str:
    """Return a page's HTML with its outputs in the place of their marks."""
    for mark, content in outputs.items():
        page = page.replace(f"<p>{mark}</p>", content)
    return page
