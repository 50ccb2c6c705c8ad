"""Formulas as MathML, which browsers draw by themselves: no script is loaded for them."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

# What pymdownx.arithmatex leaves with generic=true.
_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def with_formulas(page: str) -> str:
    """Return HTML in which every formula that arithmatex marked is drawn by MathML."""
    page = _BLOCK.sub(lambda found: f'<div class="formula">{_mathml(found[1], "block")}</div>', page)
    return _INLINE.sub(lambda found: _mathml(found[1], "inline"), page)


def _mathml(latex: str, display: str) -> str:
    made: str = convert(html.unescape(latex).strip(), display=display)
    if "\\" in made:  # A command that the library does not know comes out as it went in.
        raise PluginError(
            f"The formula {html.unescape(latex).strip()!r} has a command that cannot be drawn: {made}"
        )
    return made
