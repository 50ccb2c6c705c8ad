"""What a page shows as part of its address, so that a link shares it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from urllib.parse import parse_qsl, urlencode

from panel.io.location import Location

#: Longest text that is taken from an address; ids and names of pictures are far shorter.
_LONGEST = 4000


class Address:
    """The runs and the test picture that a browser's address names.

    Parameters
    ----------
    location:
        Holds the address as ``search``; None for a page that has none.
    """

    def __init__(self, location: Location | None = None) -> None:
        self._location = location

    def read(self) -> tuple[list[str], str]:
        """Return ids and view as they were typed: the reader checks them against its lists."""
        return read_address(self._location.search if self._location is not None else "")

    def write(self, ids: Sequence[str], view: str) -> None:
        """Name other runs and another picture; other fields stay."""
        if self._location is not None:
            search = written_address(self._location.search, ids, view)
            if search != self._location.search:
                self._location.search = search

    def field(self, name: str) -> str:
        """Return one field as it was typed, empty where it is not there."""
        search = self._location.search if self._location is not None else ""
        return dict(parse_qsl(search.removeprefix("?")[:_LONGEST])).get(name, "")

    def set_fields(self, **values: str) -> None:
        """Set fields at once, or take them away by an empty value; other fields stay."""
        if self._location is not None:
            fields = dict(parse_qsl(self._location.search.removeprefix("?")[:_LONGEST])) | values
            kept = {name: text for name, text in fields.items() if text}
            search = "?" + urlencode(kept, safe=",") if kept else ""
            if search != self._location.search:
                self._location.search = search

    def watch(self, changed: Callable[[], None]) -> None:
        """Call ``changed`` whenever the address does."""
        if self._location is not None:
            self._location.param.watch(lambda event: changed(), "search")


def read_address(search: str) -> tuple[list[str], str]:
    """Return ids and view of ``?runs=a,b&view=v``, as they were typed.

    Parameters
    ----------
    search:
        The address from its question mark on. Panel's own reading would turn a picture named ``0012`` into 12.
    """
    fields = dict(parse_qsl(search.removeprefix("?")[:_LONGEST]))
    ids = [text.strip() for text in fields.get("runs", "").split(",")]
    return list(dict.fromkeys(text for text in ids if text)), fields.get("view", "")


def written_address(search: str, ids: Sequence[str], view: str) -> str:
    """Return ``search`` with other runs and view; its other fields stay."""
    fields = dict(parse_qsl(search.removeprefix("?")[:_LONGEST]))
    fields |= {"runs": ",".join(ids), "view": view}
    kept = {name: value for name, value in fields.items() if value}
    return "?" + urlencode(kept, safe=",") if kept else ""
