"""A search for a photo's pose, step by step, in a notebook cell: drag the start, look, let it converge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import plotly.graph_objects as go

from toolkit.errors import DataError, ToolkitError
from toolkit.localize.moved import Move
from toolkit.localize.result import Localization
from toolkit.localize.starts import Start
from toolkit.localize.trail import trail_errors, trail_poses
from toolkit.metrics.localization import pose_errors
from toolkit.optional import require
from toolkit.plots.localization_pictures import localization_matches_figure
from toolkit.plots.localization_trail import trail_figure
from toolkit.runs.markup import element
from toolkit.runs.measures import format_seconds
from toolkit.runs.photo_results import StoredPose
from toolkit.runs.photo_start import POSITION_SIGMA, ROTATION_SIGMA_DEG
from toolkit.runs.pose_pictures import pose_pictures
from toolkit.runs.round_pictures import round_figure
from toolkit.scene import Frame, Scene

if TYPE_CHECKING:  # PyTorch and PyCOLMAP come with the map.
    from toolkit.localize.localizer import Localizer
    from toolkit.localize.one_shot import OneShot
    from toolkit.localize.splat_map import SplatMap

#: Name, label, most and step of the sliders.
_SLIDERS = (
    ("east", "East [m]", 40.0, 0.5),
    ("north", "North [m]", 40.0, 0.5),
    ("up", "Up [m]", 40.0, 0.5),
    ("heading", "Heading [°]", 180.0, 1.0),
    ("tilt", "Tilt [°]", 45.0, 0.5),
)
#: Longer side of the pictures: a render must be ready while the slider moves.
_SIDE = 480
_TRAIL_WIDTH = 480  # pixels
_REACH = 60.0  # metres around the true position that are drawn from above
_MILLISECONDS = 900  # between two rounds when they are played
_BAD, _GOOD = "#b3261e", "#14866d"


class LocalizeExplorer:
    """Sliders for where the search for a photo begins, and what each round of it sees.

    While a slider moves, the map is drawn from there. The button localises; then one goes from round to round.

    Parameters
    ----------
    splat_map:
        The map.
    scene:
        Its scene: photos with the poses that starts are moved from. Queries (split ``"test"``) are offered, or all
        photos with a pose where none is a query.
    methods:
        What localises in this map.
    position_sigma, rotation_sigma_deg:
        How unsure every start says it is, on each axis: ours looks around the start as far, and does not believe
        what lies much farther.
    seed:
        Of RANSAC.

    Attributes
    ----------
    done:
        What came of the last search from the start that the sliders show; None before it.

    Raises
    ------
    DataError
        For a scene without poses, and without methods.
    MissingDependencyError
        Where ipywidgets or anywidget is not installed.
    """

    def __init__(
        self,
        splat_map: SplatMap,
        scene: Scene,
        methods: Sequence[OneShot | Localizer],
        *,
        position_sigma: float = POSITION_SIGMA,
        rotation_sigma_deg: float = ROTATION_SIGMA_DEG,
        seed: int = 0,
    ) -> None:
        widgets = require("ipywidgets")
        require("anywidget")  # Plotly's own message for it does not say how to get it
        frames = scene.of_split("test") or scene.registered
        if not frames:
            raise DataError(
                "No photo of the scene has a pose", expected="poses that starts are moved from", found="0"
            )
        if not methods:
            raise DataError("Nothing localises", expected="at least one method", found="none")
        self._map, self._scene, self._seed = splat_map, scene, seed
        self._sigmas = (position_sigma, rotation_sigma_deg)
        self._frames = {frame.name: frame for frame in frames}
        self._methods = {method.name: method for method in methods}
        self._setting = False
        self.done: Localization | None = None
        self.photo = widgets.Dropdown(options=list(self._frames), description="Query")
        self.method = widgets.Dropdown(options=list(self._methods), description="Method")
        self.sliders = {
            name: widgets.FloatSlider(
                0.0,
                min=-most,
                max=most,
                step=step,
                description=label,
                readout_format=".1f",
                layout={"width": "360px"},
            )
            for name, label, most, step in _SLIDERS
        }
        self.localise = widgets.Button(description="Localise", button_style="primary", icon="crosshairs")
        self.back = widgets.Button(
            description="Start at the true pose", tooltip="All sliders to 0.", layout={"width": "180px"}
        )
        self.round = widgets.IntSlider(0, min=0, max=0, description="Round", disabled=True)
        self._play = widgets.Play(0, min=0, max=0, interval=_MILLISECONDS, disabled=True)
        self._link = widgets.jslink((self._play, "value"), (self.round, "value"))
        self.message = widgets.HTML()
        self.pictures, self.trail = go.FigureWidget(), go.FigureWidget()
        for control in (self.photo, *self.sliders.values()):
            control.observe(lambda change: self._moved(), "value")
        self.method.observe(lambda change: self._moved(), "value")
        self.round.observe(lambda change: self._show_round(), "value")
        self.localise.on_click(lambda button: self.search())
        self.back.on_click(lambda button: self.place(Move()))
        buttons = widgets.HBox([self.localise, self.back])
        # Plotly's figures take all the width that they can get.
        controls = widgets.VBox(
            [self.photo, self.method, *self.sliders.values(), buttons, self.message],
            layout={"flex": "0 0 400px"},
        )
        self.box = widgets.VBox(
            [widgets.HBox([controls, self.trail]), widgets.HBox([self._play, self.round]), self.pictures]
        )
        self._moved()

    @property
    def frame(self) -> Frame:
        """The photo that is looked for."""
        return self._frames[self.photo.value]

    @property
    def move(self) -> Move:
        """How far the start is from the photo's own pose."""
        return Move(**{name: slider.value for name, slider in self.sliders.items()})

    @property
    def start(self) -> Start:
        """Where the search begins."""
        truth = self.frame.cam_from_world
        assert truth is not None  # other frames are not offered
        return Start(self.frame.name, self.move.applied_to(truth), *self._sigmas)

    def place(self, move: Move) -> None:
        """Set all sliders at once."""
        self._setting = True
        try:
            for name, slider in self.sliders.items():
                slider.value = getattr(move, name)
        finally:
            self._setting = False
        self._moved()

    def search(self) -> None:
        """Localise the photo from the start, and show the last step."""
        self.localise.disabled, self.done = True, None
        self._tell("Localising …")
        try:
            self.done = self._localised()
        except ToolkitError as error:
            self._tell(str(error), _BAD)
            return
        finally:
            self.localise.disabled = False
        self._show_rounds(len(trail_poses(self.done)) - 1)
        self._show_answer(self.done)

    def _localised(self) -> Localization:
        from toolkit.localize.query import query_of

        method = self._methods[self.method.value]
        return method.localize(query_of(self._scene, self.frame), self.start, seed=self._seed)

    def _moved(self) -> None:
        """Show the map from the start; what was found from another one no longer counts."""
        if self._setting:
            return
        self.done = None
        self._set_rounds(0, 0)
        try:
            self._show_start()
        except ToolkitError as error:
            _redraw(self.pictures, go.Figure())
            self._tell(str(error), _BAD)

    def _show_start(self) -> None:
        start, truth = self.start, self.frame.cam_from_world
        assert truth is not None
        metres, degrees = pose_errors(start.cam_from_world, truth)
        seen = pose_pictures(self._map, self._scene, StoredPose(start.name, "", start.cam_from_world), side=_SIDE)
        drawn = localization_matches_figure(seen.photo, seen.render, seen.photo_pixels, seen.render_pixels)
        drawn.update_layout(title_text=f"start: {metres:.1f} m and {degrees:.1f}° off")
        _redraw(self.pictures, drawn)
        self._show_trail()
        self._tell("Drag the start, then press Localise.")

    def _show_rounds(self, last: int) -> None:
        """Offer the poses of the search up to ``last``, and show that one."""
        before = self.round.value
        self._set_rounds(last, last)
        if self.round.value == before:  # then nobody was told
            self._show_round()

    def _set_rounds(self, last: int, value: int) -> None:
        for control in (self.round, self._play):
            control.max, control.disabled = last, last == 0
        self._play.value = self.round.value = value

    def _show_round(self) -> None:
        if self.done is None:
            return
        # The page links both; what it knows of them must agree when it is opened.
        at = self._play.value = self.round.value
        try:
            drawn = round_figure(self._map, self._scene, self.done, at, side=_SIDE)
        except ToolkitError as error:
            self._tell(str(error), _BAD)
            return
        _redraw(self.pictures, drawn)
        self._show_trail(at)

    def _show_trail(self, at: int | None = None) -> None:
        """Show from above where the search went, or would begin."""
        poses = [self.start.cam_from_world] if self.done is None else trail_poses(self.done)
        drawn = trail_figure(
            poses,
            self.frame.cam_from_world,
            found=bool(self.done),
            at=at,
            points=self._scene.points,
            reach=_REACH,
            title="from above",
        )
        drawn.update_layout(width=_TRAIL_WIDTH)
        _redraw(self.trail, drawn)

    def _show_answer(self, done: Localization) -> None:
        spent = format_seconds(sum(done.seconds.values()))
        truth = self.frame.cam_from_world
        assert truth is not None
        way = " → ".join(f"{metres:.2f}" for metres in trail_errors(done, truth))
        if done.cam_from_world is None:
            self._tell(f"Not found: {done.reason} ({spent}). On the way: {way} m off.", _BAD)
            return
        metres, degrees = pose_errors(done.cam_from_world, truth)
        sure = "" if done.position_sigma is None else f", believed to ±{done.position_sigma.max():.2f} m"
        self._tell(
            f"Found: {metres:.2f} m and {degrees:.2f}° off{sure}; {done.inliers} of {done.matches} matches agree "
            f"({spent}). On the way: {way} m off.",
            _GOOD,
        )

    def _tell(self, text: str, colour: str = "inherit") -> None:
        self.message.value = str(element("div", text, style=f"color: {colour}; max-width: 380px; line-height: 1.4"))

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self.box._repr_mimebundle_(**options) or {}
        return shown


def _redraw(shown: go.FigureWidget, drawn: go.Figure) -> None:
    """Let a figure that is on the page show another one; Plotly sends what differs."""
    with shown.batch_update():
        if [trace.type for trace in shown.data] == [trace.type for trace in drawn.data]:
            for old, new in zip(shown.data, drawn.data, strict=True):
                old.update(new.to_plotly_json())
        else:
            shown.data = ()
            shown.add_traces(drawn.data)
        shown.update_layout(drawn.layout.to_plotly_json())
