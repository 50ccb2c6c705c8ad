"""HTML in which everything is escaped unless it was made here."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import Any

_VOID = frozenset({"img", "input", "meta", "br"})


class Html(str):
    """Text that is HTML already. Everything else is escaped where it is put into an element."""

    __slots__ = ()


Content = Html | str | Iterable["Content"] | None


def element(tag: str, *children: Content, **attributes: Any) -> Html:
    """Return an element.

    Parameters
    ----------
    children:
        :class:`Html` as it is, texts escaped, lists one after the other, None left out.
    attributes:
        A trailing underscore is dropped (``class_``), others become dashes (``data_run``); True stands alone, None
        and False are left out; every value is escaped.
    """
    written = []
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        key = name.rstrip("_").replace("_", "-")
        written.append(f" {key}" if value is True else f' {key}="{html.escape(str(value))}"')
    opened = f"<{tag}{''.join(written)}>"
    return Html(opened if tag in _VOID else f"{opened}{joined(children)}</{tag}>")


def joined(content: Content) -> Html:
    """Return content as HTML, escaping what is not."""
    if content is None:
        return Html("")
    if isinstance(content, Html):
        return content
    if isinstance(content, str):
        return Html(html.escape(content))
    return Html("".join(joined(item) for item in content))


def table(head: Iterable[Content], rows: Iterable[Iterable[Content]], class_: str = "") -> Html:
    """Return a table that scrolls sideways on narrow screens; cells that are no elements are wrapped.

    The first cell of a row is its heading.
    """

    def cell(content: Content, tag: str) -> Html:
        if isinstance(content, Html) and content.startswith(("<td", "<th")):
            return content
        return element(tag, content)

    top = element("tr", [element("th", content, scope="col") for content in head])
    body = []
    for row in rows:
        first, *rest = row
        body.append(element("tr", element("th", first, scope="row"), [cell(content, "td") for content in rest]))
    drawn = element("table", element("thead", top), element("tbody", body), class_=class_ or None)
    return element("div", drawn, class_="scroll")
