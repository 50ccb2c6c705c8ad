"""Small drawings as SVG: lines, boxes, arrows and text on a white card that is legible on light and dark pages."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path

INK, SOFT, BLUE, ORANGE, GREEN = "#1f2430", "#8a92a3", "#3b5bdb", "#e8590c", "#2b8a3e"
Point = tuple[float, float]


class Drawing:
    """A picture of a size in pixels, to which things are added in order."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self._size, self._title, self._parts = (
            (width, height),
            title,
            [f'<rect width="{width}" height="{height}" rx="8" fill="#ffffff"/>'],
        )

    def text(
        self,
        at: Point,
        words: str,
        *,
        size: int = 14,
        colour: str = INK,
        anchor: str = "middle",
        bold: bool = False,
    ) -> None:
        """Write a line of words; ``at`` is the middle of its base line, or its end by ``anchor``."""
        weight = ' font-weight="600"' if bold else ""
        self._parts.append(
            f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" font-size="{size}" fill="{colour}" '
            f'text-anchor="{anchor}"{weight}>{escape(words)}</text>'
        )

    def box(self, corner: Point, size: Point, words: Iterable[str] = (), *, colour: str = BLUE) -> None:
        """Draw a box with lines of words in its middle, the first one bold."""
        (x, y), (w, h) = corner, size
        self._parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}" rx="6" fill="{colour}" '
            f'fill-opacity="0.08" stroke="{colour}" stroke-width="1.5"/>'
        )
        lines = list(words)
        for i, line in enumerate(lines):
            height = y + h / 2 + 5 + 17 * (i - (len(lines) - 1) / 2)
            self.text((x + w / 2, height), line, size=14 if i == 0 else 12, bold=i == 0)

    def line(self, points: Iterable[Point], *, colour: str = INK, width: float = 1.5, dashed: bool = False) -> None:
        """Draw a line through points."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        self._parts.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{dash}/>'
        )

    def arrow(self, start: Point, end: Point, *, colour: str = INK, width: float = 1.5) -> None:
        """Draw an arrow."""
        self._parts.append(
            f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" stroke="{colour}" '
            f'stroke-width="{width}" marker-end="url(#head)"/>'
        )

    def dot(self, at: Point, *, radius: float = 4, colour: str = INK) -> None:
        """Draw a dot."""
        self._parts.append(f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius}" fill="{colour}"/>')

    def write(self, path: Path) -> None:
        """Write the drawing."""
        width, height = self._size
        head = (
            '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            'orient="auto"><path d="M0 0 8 4 0 8z" fill="context-stroke"/></marker></defs>'
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
            f'height="{height}" '
            f'font-family="system-ui, sans-serif" role="img"><title>{escape(self._title)}</title>{head}'
            + "\n".join(self._parts)
            + "</svg>\n",
            encoding="utf-8",
        )
