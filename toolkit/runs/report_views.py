"""Test photos beside the renders of each run, embedded into the page."""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from toolkit.progress import Progress, track
from toolkit.recipes.base import TestView
from toolkit.runs.compare import ComparedRun
from toolkit.runs.markup import Content, Html, element
from toolkit.runs.measures import best_of

_QUALITY = 88


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
        try:
            with Image.open(path) as opened:
                picture = opened.convert("RGB")
        except (OSError, UnidentifiedImageError, ValueError):
            return None
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
) -> Html:
    """Return the card of one test picture: photo and render of each run that has it, with a slider between them."""
    shown = [(i, of_run[name]) for i, of_run in enumerate(found.views) if name in of_run]
    best = best_of("psnr", [view.psnr for _, view in shown]) if mark_best else frozenset()
    panels = [
        _panel(book, runs[i], view, dots[i], len(runs) > 1, place in best) for place, (i, view) in enumerate(shown)
    ]
    slider = element(
        "input", type="range", min=0, max=100, value=50, aria_label=f"Photo and render of {name}: dividing line"
    )
    return element(
        "article",
        element("h3", name),
        element("div", panels, class_="panels"),
        slider,
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


def _panel(book: PictureBook, item: ComparedRun, view: TestView, dot: Html, named: bool, best: bool) -> Html:
    """Return one run's photo and render of a view, with its measures."""
    photo = book.image(item.run.artifacts / view.photo, "photo", f"Photo {view.name}")
    render = book.image(item.run.artifacts / view.render, "render", f"Render of {view.name} by {item.label}")
    pictures: Content
    if photo is None or render is None:
        pictures = element("p", "The pictures of this view are missing.", class_="note")
    else:
        tags = [element("span", "photo", class_="tag left"), element("span", "render", class_="tag right")]
        pictures = element("div", photo, render, tags, class_="stack")
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
