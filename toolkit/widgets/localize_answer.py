"""What came of a photo: facts, the photo against the render from its pose, and the matches."""

from __future__ import annotations

import base64
import io

import numpy as np
import panel as pn
from numpy.typing import NDArray
from PIL import Image

from toolkit.plots.localization_pictures import localization_matches_figure
from toolkit.plots.style import shown
from toolkit.runs.localize_work import PhotoAnswer
from toolkit.runs.markup import Html, element
from toolkit.runs.measures import format_seconds
from toolkit.runs.report_html import VIEW_MODES
from toolkit.runs.view_scene import ViewCamera, ViewScene
from toolkit.widgets.pictures import PictureCard
from toolkit.widgets.style import html_pane, plot_pane, show_figure, show_html

_QUALITY = 88
_MODES = {text: mode for mode, text in VIEW_MODES.items()}


class LocalizeAnswer(pn.viewable.Viewer):
    """Shows one answer at a time; nothing takes no room."""

    def __init__(self, *, dark: bool = False) -> None:
        super().__init__()
        self._dark = dark
        self._facts = html_pane()
        self._mode = pn.widgets.RadioButtonGroup(
            options=_MODES,
            value="slide",
            color="primary",
            variant="outline",
            stylesheets=[".bk-btn.bk-active { color: #ffffff !important; }"],
            margin=(0, 0, 8, 0),
        )
        self._card = PictureCard(sizing_mode="stretch_width", margin=0)
        self._matches = plot_pane()
        self._mode.param.watch(lambda event: setattr(self._card, "mode", event.new), "value")
        side = pn.Column(self._facts, sizing_mode="stretch_width", margin=0)
        side.styles = {"flex": "1 1 300px", "min-width": "0"}
        pictures = pn.Column(self._mode, self._card, sizing_mode="stretch_width", margin=0)
        pictures.styles = {"flex": "2 1 440px", "min-width": "0"}
        top = pn.FlexBox(side, pictures, gap="18px", sizing_mode="stretch_width", margin=(0, 0, 12, 0))
        self._layout = pn.Column(top, self._matches, sizing_mode="stretch_width", margin=0, visible=False)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def display(self, answer: PhotoAnswer | None) -> None:
        """Show another answer, None for none."""
        self._layout.visible = answer is not None
        if answer is None:
            self._card.content = ""
            show_html(self._facts)
            show_figure(self._matches, None, dark=self._dark)
            return
        show_html(self._facts, answer_facts(answer))
        self._card.content = str(_card(answer))
        pictures = answer.pictures
        drawn = None
        if len(pictures.inside):
            drawn = localization_matches_figure(
                pictures.photo,
                pictures.render,
                pictures.photo_pixels,
                pictures.render_pixels,
                inlier=pictures.inside,
            )
            # Those that are kept are a part of all.
            drawn.update_layout(title_text=_heading(answer))
        show_figure(self._matches, drawn, dark=self._dark)


def answer_cameras(view: ViewScene, answer: PhotoAnswer) -> tuple[ViewCamera, ...]:
    """Return the photo's camera where it was found, and where its search began, as a viewer draws them."""
    places = (("query", answer.pose.cam_from_world), ("start", answer.pose.start))
    camera, pictures = answer.pictures.camera, answer.pictures
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    return tuple(
        ViewCamera(
            name=answer.pose.name,
            use="query" if use == "query" else "start",
            position=pose.centre - view.centre,
            rotation=pose.inverse().quaternion,
            focal=(fx, fy),
            principal=(cx, cy),
            size=(camera.width, camera.height),
            distance=pictures.distance,
            photo=pictures.file,
        )
        for use, pose in places
        if pose is not None
    )


def answer_facts(answer: PhotoAnswer) -> Html:
    """Return a table of what was found, or why nothing was."""
    pose, unit = answer.pose, "m" if answer.pictures.metric else "units"
    found = pose.cam_from_world
    rows: list[tuple[str, str]] = [("Photo", pose.name), ("Method", pose.method)]
    if found is None:
        rows.append(("Not found", pose.reason or "no reason is given"))
    else:
        rows.append(("Position", f"{', '.join(f'{value:,.3f}' for value in found.centre)} {unit}"))
        if pose.position_sigma is not None:
            sigmas = ", ".join(f"{value:.2g}" for value in pose.position_sigma)
            rows.append(("± on each axis", f"{sigmas} {unit}"))
        if pose.rotation_sigma_deg is not None:
            rows.append(("± of the rotation", ", ".join(f"{value:.2g}°" for value in pose.rotation_sigma_deg)))
    rows.append(("Matches that agree", f"{pose.inliers:,} of {pose.matches:,}"))
    rows.append(("Renders matched", str(pose.rounds)))
    if pose.seconds:
        parts = ", ".join(f"{part} {value:.1f}" for part, value in pose.seconds.items())
        rows.append(("Time", f"{format_seconds(sum(pose.seconds.values()))} ({parts} s)"))
    if answer.start_errors is not None:
        rows.append(("Start was off by", _off(answer.start_errors, unit)))
    if answer.errors is not None:
        rows.append(("Off the scene's pose by", _off(answer.errors, unit)))
    state = "finished" if found is not None else "failed"
    badge = element("span", "found" if found is not None else "not found", class_=f"badge {state}")
    cells = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in rows]
    return element("div", element("p", badge, style="margin:12px 14px"), _table(cells), class_="card")


def _table(rows: list[Html]) -> Html:
    return element("div", element("table", element("tbody", rows), class_="text"), class_="scroll")


def _heading(answer: PhotoAnswer) -> str:
    pose = answer.pose
    return shown(f"{pose.name}: {pose.inliers:,} of {pose.matches:,} matches agree, some of them are drawn")


def _off(errors: tuple[float, float], unit: str) -> str:
    return f"{errors[0]:.3g} {unit}, {errors[1]:.2g}°"


def _card(answer: PhotoAnswer) -> Html:
    """Return photo and render on top of each other, as the report's cards have them."""
    found = answer.pose.cam_from_world is not None
    name = answer.pose.name
    text = "render from the found pose" if found else "render from where it was looked for"
    slider = element("input", type="range", min=0, max=100, value=50, aria_label=f"{name}: dividing line")
    zooms = [
        element("button", sign, type="button", data_zoom=factor, aria_label=label, title=label)
        for sign, factor, label in (("−", 0.5, "Zoom out"), ("+", 2, "Zoom in"), ("1:1", 0, "Whole picture"))
    ]
    tags = [element("span", "photo", class_="tag left"), element("span", "render", class_="tag right")]
    stack = element(
        "div",
        _image(answer.pictures.photo, f"Photo {name}"),
        element("div", _image(answer.pictures.render, f"{name}: {text}"), class_="over"),
        tags,
        class_="stack",
        tabindex=0,
        role="group",
        aria_label=f"{name}: plus and minus zoom, arrows move, 0 shows all",
    )
    return element(
        "article",
        element(
            "div",
            element("h3", f"Photo and {text}"),
            element("div", zooms, class_="zooms", role="group"),
            class_="top",
        ),
        element("div", element("figure", stack), class_="panels"),
        slider,
        class_="card view",
        style="--split:50%",
    )


def _image(picture: NDArray[np.uint8], text: str) -> Html:
    memory = io.BytesIO()
    Image.fromarray(picture).save(memory, "JPEG", quality=_QUALITY, optimize=True)
    source = "data:image/jpeg;base64," + base64.b64encode(memory.getvalue()).decode("ascii")
    return element("img", alt=text, src=source, width=picture.shape[1], height=picture.shape[0])
