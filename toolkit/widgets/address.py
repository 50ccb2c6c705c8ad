"""What a page shows as part of its address, so that a link shares it."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import parse_qsl, urlencode

#: Longest text that is taken from an address; ids and names of pictures are far shorter.
_LONGEST = 4000


def read_address(search: str) -> tuple[list[str], str]:
    """Return ids and view of ``?runs=a,b&view=v``, as they were typed: the reader checks them against its lists.

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
