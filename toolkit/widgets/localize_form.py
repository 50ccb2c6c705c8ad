"""The form that asks for a photo's pose: which photo, where the search begins, and how."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import panel as pn

from toolkit.runs.localize_photo import METHODS, feature_choices
from toolkit.runs.localize_work import PhotoRequest
from toolkit.runs.photo_start import POSITION_SIGMA, ROTATION_SIGMA_DEG, StartChoice, standing_start
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewScene
from toolkit.widgets.style import SELECT
from toolkit.widgets.upload import ZipUpload

#: Bytes of the largest photo.
LARGEST_PHOTO: Final = 100 * 10**6
#: Where the search begins.
HERE, SENSORS, OWN = "here", "sensors", "own"
_STARTS = {"from where I stand": HERE, "from its sensors": SENSORS, "from its own pose, moved": OWN}
_METHODS = {"ours": "ours: again until it stands still", "one-shot": "one shot, as the paper"}
_UPLOADS = ".uploads"
_FILE = ("file", "")
_OWN_METRES, _OWN_DEGREES = 5.0, 5.0
_FIELD: dict[str, Any] = {"width": 210, "margin": (0, 12, 8, 0), "stylesheets": [SELECT]}
_NUMBER: dict[str, Any] = {"width": 150, "margin": (0, 12, 8, 0), "start": 0.0}


class PhotoUpload(ZipUpload):
    """A field for one photo."""

    _what, _larger = "a photo", ""


class LocalizeForm(pn.viewable.Viewer):
    """Chooses what :class:`PhotoRequest` asks for.

    Parameters
    ----------
    runs_dir:
        Photos of a browser lie in a hidden folder of it as long as they are needed.
    tell:
        Called with what is wrong with an upload, empty where nothing is.
    """

    def __init__(self, runs_dir: Path, tell: Callable[[str], None]) -> None:
        super().__init__()
        self._view: ViewScene | None = None
        self._tell = tell
        self._sent: tuple[str, Path] | None = None
        self._photo = pn.widgets.Select(label="Photo", options={"none": ("", "")}, **_FIELD)
        self._start = pn.widgets.Select(label="Search", options=_STARTS, value=HERE, **_FIELD)
        self._metres = pn.widgets.FloatInput(
            label="Unsure by ± [m]", value=POSITION_SIGMA, step=1.0, end=1e6, **_NUMBER
        )
        self._degrees = pn.widgets.FloatInput(
            label="Unsure by ± [°]", value=ROTATION_SIGMA_DEG, step=1.0, end=180.0, **_NUMBER
        )
        self._moved = pn.widgets.FloatInput(
            label="Moved by [m]", value=_OWN_METRES, step=1.0, end=1e6, visible=False, **_NUMBER
        )
        self._turned = pn.widgets.FloatInput(
            label="Turned by [°]", value=_OWN_DEGREES, step=1.0, end=180.0, visible=False, **_NUMBER
        )
        self._method = pn.widgets.Select(
            label="Method", options={_METHODS[name]: name for name in METHODS}, value="ours", **_FIELD
        )
        self._features = pn.widgets.Select(label="Features", options=list(feature_choices()), **_FIELD)
        self._method.param.watch(lambda event: self._take_method(), "value")
        self._take_method()
        self.upload = PhotoUpload(
            runs_dir / _UPLOADS,
            take=self._take,
            refuse=tell,
            most=LARGEST_PHOTO,
            label="Photo of a camera of the map",
            accept=".jpg,.jpeg,.png,.tif,.tiff,image/jpeg,image/png,image/tiff",
            visible=False,
            margin=(0, 0, 8, 0),
        )
        self._photo.param.watch(lambda event: self._fit(), "value")
        self._start.param.watch(lambda event: self._fit(), "value")
        fields = (self._photo, self._start, self._metres, self._degrees, self._moved, self._turned)
        row = pn.FlexBox(
            *fields, self._method, self._features, align_items="flex-end", sizing_mode="stretch_width", margin=0
        )
        self._layout = pn.Column(row, self.upload, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def start(self) -> str:
        """Where the search begins: :data:`HERE`, :data:`SENSORS` or :data:`OWN`."""
        return str(self._start.value)

    @property
    def ready(self) -> bool:
        """Whether a photo is chosen."""
        return self._view is not None and (self._photo.value[0] == "frame" or self._picture() is not None)

    def offer(self, view: ViewScene | None) -> None:
        """List the frames of another run; a photo that was sent stays."""
        self._view = view
        options: dict[str, tuple[str, str]] = {}
        if view is not None:
            uses = [(camera.name, str(camera.use)) for camera in view.cameras if camera.use in ("train", "test")]
            named = _tests_first(uses) + [(name, "no pose") for name in view.unposed]
            options = {f"{name} ({use})": ("frame", name) for name, use in named}
            options["a picture file of mine …"] = _FILE
        before = self._photo.value
        kept = before if before in options.values() else next(iter(options.values()), ("", ""))
        self._photo.param.update(options=options or {"none": ("", "")}, value=kept)
        self._fit()

    def choose(self, name: str) -> None:
        """Choose a frame by its name, where the run has it."""
        if ("frame", name) in self._photo.options.values():
            self._photo.value = ("frame", name)

    def request(self, standing: ViewPose | None = None) -> PhotoRequest:
        """Return what is asked for.

        Parameters
        ----------
        standing:
            Of the viewer, where the search begins there.

        Raises
        ------
        SettingsError
            For standard deviations that cannot be.
        """
        assert self._view is not None  # or the form is not ready
        kind, name = self._photo.value
        picture = None
        if kind == "file":
            sent = self._picture()
            assert sent is not None  # or the form is not ready
            name, picture = sent
        return PhotoRequest(
            self._view.run,
            name,
            self._choice(standing),
            str(self._method.value),
            str(self._features.value),
            picture,
        )

    def leave(self) -> None:
        """Delete the photo that was sent: nobody needs it any more."""
        self.upload.drop()
        if self._sent is not None:
            self._sent[1].unlink(missing_ok=True)
            self._sent = None

    def _choice(self, standing: ViewPose | None) -> StartChoice:
        if self.start == SENSORS:
            return StartChoice("prior")
        if self.start == OWN:
            return StartChoice("own", metres=float(self._moved.value or 0), degrees=float(self._turned.value or 0))
        assert self._view is not None  # or the form is not ready
        assert standing is not None  # or the viewer was not asked
        return standing_start(self._view, standing, float(self._metres.value or 0), float(self._degrees.value or 0))

    def _picture(self) -> tuple[str, Path] | None:
        """Return name and place of the file that was sent, where a file is chosen and it is still there."""
        if self._photo.value[0] != "file" or self._sent is None or not self._sent[1].is_file():
            return None
        return self._sent

    def _take(self, name: str, path: Path) -> None:
        if self._sent is not None:
            self._sent[1].unlink(missing_ok=True)
        # What a browser calls a file is a name and no path.
        self._sent = (name.replace("\\", "/").rpartition("/")[2][:200] or "photo", path)
        self._tell("")

    def _take_method(self) -> None:
        """Choose the features that the method was made with."""
        self._features.value = METHODS[str(self._method.value)]().match.method

    def _fit(self) -> None:
        """Show the fields that the choices need."""
        self.upload.visible = self._photo.value[0] == "file"
        for field in (self._metres, self._degrees):
            field.visible = self.start == HERE
        for field in (self._moved, self._turned):
            field.visible = self.start == OWN


def _tests_first(uses: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the frames that the map was not made from before the others."""
    return sorted(uses, key=lambda pair: pair[1] != "test")
