"""Test photos beside the renders of each run, embedded into the page."""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from toolkit.progress import Progress, track
from toolkit.recipes.base import TestView
from toolkit.runs.compare import ComparedRun
from toolkit.runs.markup import Content, Html, element
from toolkit.runs.measures import best_of

_QUALITY = 88
#: Mean absolute difference of the channels, in levels of 255, that the error map shows as white.
_MOST_ERROR = 64
ERROR_SCALE = (
    f"Error map: mean absolute difference of red, green and blue, from black (0) over purple and orange to white "
    f"({_MOST_ERROR} levels of 255 or more)."
)
# Level, red, green, blue, from dark to light in even steps of brightness.
_ERROR_COLOURS = ((0, 0, 0, 0), (16, 74, 24, 110), (32, 190, 55, 84), (48, 248, 150, 40), (64, 255, 255, 240))


@dataclass(frozen=True, slots=True)
class ViewsByName:
    """The test pictures of all runs.

    Attributes
    ----------
    names:
        The picture with the lowest PSNR in any run first.
    views:
        For each run, its views by name.
    """

    names: tuple[str, ...]
    views: tuple[Mapping[str, TestView], ...]


def views_by_name(runs: Sequence[ComparedRun]) -> ViewsByName:
    """Return the test pictures of all runs, worst first."""
    views = tuple({view.name: view for view in item.result.test_views} if item.result else {} for item in runs)
    worst: dict[str, float] = {}
    for of_run in views:
        for name, view in of_run.items():
            worst[name] = min(worst.get(name, math.inf), -math.inf if math.isnan(view.psnr) else view.psnr)
    return ViewsByName(tuple(sorted(worst, key=lambda name: (worst[name], name))), views)


class PictureBook:
    """Embeds pictures as JPEG, each content once."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._places: dict[str, str] = {}

    def image(self, path: Path, class_: str, alt: str) -> Html | None:
        """Return an ``img`` with the picture in ``path``, None where it cannot be read.

        A picture that the page already has is named and taken over by the page's script.
        """
        picture = _opened(path)
        return None if picture is None else self._placed(picture, class_, alt)

    def errors(self, photo: Path, render: Path, alt: str) -> Html | None:
        """Return an ``img`` of the error of each pixel (see :data:`ERROR_SCALE`), None where one cannot be read."""
        first, second = _opened(photo), _opened(render)
        if first is None or second is None:
            return None
        if first.size != second.size:
            first = first.resize(second.size, Image.Resampling.LANCZOS)
        return self._placed(error_picture(first, second), "error", alt)

    def _placed(self, picture: Image.Image, class_: str, alt: str) -> Html:
        if picture.width > self._width:
            height = max(1, round(picture.height * self._width / picture.width))
            picture = picture.resize((self._width, height), Image.Resampling.LANCZOS)
        memory = io.BytesIO()
        picture.save(memory, "JPEG", quality=_QUALITY, optimize=True)
        content = memory.getvalue()
        digest = hashlib.sha256(content).hexdigest()
        size = {"width": picture.width, "height": picture.height}
        if digest in self._places:
            return element("img", class_=class_, alt=alt, data_same=self._places[digest], **size)
        place = self._places[digest] = f"picture-{len(self._places)}"
        source = "data:image/jpeg;base64," + base64.b64encode(content).decode("ascii")
        return element("img", id=place, class_=class_, alt=alt, src=source, **size)


def view_card(
    runs: Sequence[ComparedRun],
    found: ViewsByName,
    name: str,
    dots: Sequence[Html],
    book: PictureBook,
    *,
    mark_best: bool,
    errors: bool = False,
) -> Html:
    """Return the card of one test picture: photo and render of each run that has it, with a slider between them.

    ``errors`` adds a map of each pixel's error, which the mode ``error`` shows.
    """
    shown = [(i, of_run[name]) for i, of_run in enumerate(found.views) if name in of_run]
    best = best_of("psnr", [view.psnr for _, view in shown]) if mark_best else frozenset()
    panels = [
        _panel(book, runs[i], view, dots[i], len(runs) > 1, place in best, errors)
        for place, (i, view) in enumerate(shown)
    ]
    slider = element(
        "input", type="range", min=0, max=100, value=50, aria_label=f"Photo and render of {name}: dividing line"
    )
    zooms = [
        element("button", text, type="button", data_zoom=factor, aria_label=label, title=label)
        for text, factor, label in (("−", 0.5, "Zoom out"), ("+", 2, "Zoom in"), ("1:1", 0, "Whole picture"))
    ]
    return element(
        "article",
        element("div", element("h3", name), element("div", zooms, class_="zooms", role="group"), class_="top"),
        element("div", panels, class_="panels"),
        slider,
        element("p", ERROR_SCALE, class_="note scale") if errors else None,
        class_="card view",
        style="--split:50%",
    )


def view_cards(
    runs: Sequence[ComparedRun],
    found: ViewsByName,
    dots: Sequence[Html],
    *,
    most: int,
    width: int,
    mark_best: bool,
    progress: Progress,
) -> Html:
    """Return a card for each of the first ``most`` pictures."""
    book = PictureBook(width)
    cards = [
        view_card(runs, found, name, dots, book, mark_best=mark_best)
        for name in track(found.names[:most], "report.pictures", progress)
    ]
    return element("div", cards, class_="views", style=f"--view:{min(1180, 380 * max(1, len(runs)))}px")


def _panel(
    book: PictureBook, item: ComparedRun, view: TestView, dot: Html, named: bool, best: bool, errors: bool
) -> Html:
    """Return one run's photo and render of a view, with its measures."""
    photo = book.image(item.run.artifacts / view.photo, "photo", f"Photo {view.name}")
    render = book.image(item.run.artifacts / view.render, "render", f"Render of {view.name} by {item.label}")
    pictures: Content
    if photo is None or render is None:
        pictures = element("p", "The pictures of this view are missing.", class_="note")
    else:
        tags = [element("span", "photo", class_="tag left"), element("span", "render", class_="tag right")]
        places = item.run.artifacts / view.photo, item.run.artifacts / view.render
        of_errors = book.errors(*places, f"Error of {view.name} by {item.label}") if errors else None
        pictures = element(
            "div",
            photo,
            element("div", render, class_="over"),
            of_errors,
            tags,
            class_="stack",
            tabindex=0,
            role="group",
            aria_label=f"{view.name} by {item.label}: plus and minus zoom, arrows move, 0 shows all",
        )
    score = [element("b", _decibel(view.psnr)), f" · SSIM {view.ssim:.3f}"]
    if view.lpips is not None:
        score.append(f" · LPIPS {view.lpips:.3f}")
    caption = element(
        "figcaption",
        [dot, element("span", item.label, class_="name")] if named else None,
        element("span", score, class_="score best" if best else "score"),
    )
    return element("figure", pictures, caption)


def _decibel(psnr: float) -> str:
    return "PSNR –" if math.isnan(psnr) else f"{psnr:.2f} dB"


def error_picture(photo: Image.Image, render: Image.Image) -> Image.Image:
    """Return the error of each pixel of two RGB pictures of one size in the colours of :data:`ERROR_SCALE`."""
    first, second = np.asarray(photo, np.float32), np.asarray(render, np.float32)
    error = np.abs(first - second).mean(axis=2)
    levels, *channels = zip(*_ERROR_COLOURS, strict=True)
    table = np.stack([np.interp(np.arange(_MOST_ERROR + 1), levels, channel) for channel in channels], axis=1)
    return Image.fromarray(np.rint(table[np.clip(np.rint(error), 0, _MOST_ERROR).astype(int)]).astype(np.uint8))


def _opened(path: Path) -> Image.Image | None:
    """Return a picture in RGB, None where it cannot be read."""
    try:
        with Image.open(path) as opened:
            return opened.convert("RGB")
    except (OSError, UnidentifiedImageError, ValueError):
        return None
