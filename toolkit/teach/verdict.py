"""What a check says of an answer."""

from __future__ import annotations

import html
import re
from dataclasses import dataclass
from typing import Literal

State = Literal["open", "wrong", "right"]

# The words say it, too: colour alone would leave out who sees none.
_HEADS: dict[State, str] = {"open": "Your turn", "wrong": "Not yet", "right": "Right"}
# Strong enough beside black and beside white; the ground is a tint of them, the text keeps the page's colour.
_COLOURS: dict[State, str] = {"open": "74, 134, 232", "wrong": "224, 122, 32", "right": "46, 160, 80"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """A check's answer; a notebook shows it as a coloured box, a terminal as text.

    Parameters
    ----------
    exercise:
        Name of the exercise, ``"tour.pairs"``.
    state:
        ``"open"`` where there is no answer yet (or the data do not tell), ``"wrong"`` or ``"right"``.
    text:
        How to answer, a hint, or the explanation: ``code`` between backticks, emphasis between asterisks.
    """

    exercise: str
    state: State
    text: str

    def __repr__(self) -> str:
        return f"{self.exercise}: {self.state}. {self.text}"

    def _repr_html_(self) -> str:
        colour = _COLOURS[self.state]
        said = _marked_up(html.escape(self.text, quote=False))
        style = f"border-left: 4px solid rgb({colour}); background: rgba({colour}, 0.14); color: inherit"
        return (
            f'<div style="{style}; padding: 8px 14px; margin: 4px 0; max-width: 90ch; line-height: 1.5">'
            f"<strong>{_HEADS[self.state]}</strong> "
            f'<span style="opacity: 0.7">{html.escape(self.exercise)}</span><br>{said}</div>'
        )


def _marked_up(text: str) -> str:
    """Return escaped text with its code and its emphasis as HTML; asterisks in code stay."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # one backtick alone
        return text
    plain = (re.sub(r"\*([^*]+)\*", r"<em>\1</em>", part) for part in parts[::2])
    code = [f"<code>{part}</code>" for part in parts[1::2]]
    return "".join(a + b for a, b in zip(plain, [*code, ""], strict=True))
