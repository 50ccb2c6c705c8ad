"""Photos localised in a finished run's map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from toolkit.errors import DataError, SettingsError
from toolkit.files import disk_errors
from toolkit.localize.query import Query
from toolkit.localize.result import Localization
from toolkit.localize.settings import LocalizeSettings, OneShotSettings, SequenceSettings
from toolkit.localize.starts import Start
from toolkit.metrics.localization import pose_errors
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.runs.folder import RunFolder
from toolkit.runs.photo_query import Photo
from toolkit.runs.run_map import open_run_map

if TYPE_CHECKING:  # PyTorch and PyCOLMAP come with the first map that is opened.
    from toolkit.localize.localizer import Localizer
    from toolkit.localize.one_shot import OneShot
    from toolkit.localize.splat_map import SplatMap
    from toolkit.matching.picture_features import PictureFeatures, PictureMatcher, PictureMatches
    from toolkit.scene import Scene

Method = LocalizeSettings | OneShotSettings
METHODS: Final[Mapping[str, type[LocalizeSettings] | type[OneShotSettings]]] = {
    "ours": LocalizeSettings,
    "one-shot": OneShotSettings,
}
#: The stage of one photo in progress events.
STAGE: Final = "localize.photo"


def feature_choices() -> tuple[str, ...]:
    """Return the names of the features that can be chosen."""
    return tuple(LocalizeSettings.declaration("match.method").objects)


def method_settings(method: str, *, features: str | None = None, changes: Sequence[str] = ()) -> Method:
    """Return the settings of a method by its name.

    Parameters
    ----------
    method:
        One of :data:`METHODS`.
    features:
        One of :func:`feature_choices`; None: the default.
    changes:
        Texts ``key=value`` that come last.

    Raises
    ------
    SettingsError
        For an unknown method, and changes that cannot be.
    """
    if method not in METHODS:
        raise SettingsError(f"Unknown method '{method}'", expected="one of " + ", ".join(METHODS))
    settings = METHODS[method]()
    if features is not None:
        settings = settings.replace({"match.method": features})
    return settings.replace_from_text(changes)


def check_follows(settings: Method) -> None:
    """Raise :class:`SettingsError` where a method cannot follow a flight."""
    if isinstance(settings, OneShotSettings):
        raise SettingsError("The one shot cannot follow a flight", expected="the method ours", found="one-shot")


@dataclass(frozen=True, slots=True, eq=False)
class LocalizedPhoto:
    """What came of one photo.

    Attributes
    ----------
    photo, start:
        What was asked.
    found:
        The answer.
    method:
        What the method is called in tables.
    settings:
        Of the method, under their names.
    seed:
        Of every random choice.
    """

    photo: Photo
    start: Start
    found: Localization
    method: str
    settings: dict[str, Any]
    seed: int

    @property
    def errors(self) -> tuple[float, float] | None:
        """Metres and degrees from the pose that the scene has; None where it has none or nothing was found."""
        if self.photo.truth is None or self.found.cam_from_world is None:
            return None
        return pose_errors(self.found.cam_from_world, self.photo.truth)

    @property
    def start_errors(self) -> tuple[float, float] | None:
        """The same of the start."""
        return None if self.photo.truth is None else pose_errors(self.start.cam_from_world, self.photo.truth)

    @property
    def seconds(self) -> float:
        """Wall time."""
        return float(sum(self.found.seconds.values()))


class PhotoLocalizer:
    """Localises photos in a run's map, one after the other.

    Parameters
    ----------
    run:
        A finished run with a splat.
    settings:
        Their class says which method it is.
    device:
        ``"cpu"`` or ``"cuda"``.
    splat_map:
        The run's, where it is open already.

    Raises
    ------
    RunError, DataError, CapabilityError
        As :func:`toolkit.runs.run_map.open_run_map`.
    MissingDependencyError, WeightsMissingError
        Where a network or its weights are missing.
    """

    def __init__(
        self, run: RunFolder, settings: Method, *, device: str = "cpu", splat_map: SplatMap | None = None
    ) -> None:
        self.splat_map = splat_map if splat_map is not None else open_run_map(run, device=device)
        self.settings = settings.frozen()
        self.scene = run_scene(run)
        from toolkit.localize.localizer import Localizer
        from toolkit.localize.one_shot import OneShot
        from toolkit.matching.picture_features import picture_matcher

        self._told = _ToldMatcher(picture_matcher(settings.match, device=device))
        self._method: Localizer | OneShot
        if isinstance(settings, OneShotSettings):
            self._method = OneShot(self.splat_map, settings, matcher=self._told)
        else:
            self._method = Localizer(self.splat_map, settings, matcher=self._told)

    def localize(self, photo: Photo, start: Start, *, seed: int = 0, progress: Progress = silent) -> LocalizedPhoto:
        """Return what comes of a photo.

        Parameters
        ----------
        seed:
            Of RANSAC.
        progress:
            Told of every picture in which features are looked for; raises to cancel.
        """
        self._told.listen(progress)
        return self._made(photo, start, self._method.localize(photo.query, start, seed=seed), seed)

    def localize_flight(
        self,
        photos: Sequence[Photo],
        start: Start,
        settings: SequenceSettings,
        *,
        seed: int = 0,
        progress: Progress = silent,
    ) -> tuple[LocalizedPhoto, ...]:
        """Localise photos of one flight in order of their times, each where the ones before it lead.

        Parameters
        ----------
        start:
            Of the first one. The others' starts in the results are this one, too: what leads to them is the
            sequence.

        Raises
        ------
        SettingsError
            With the one shot, which knows nothing of sequences.
        DataError
            For a photo without a time, or two of one time.
        """
        from toolkit.localize.localizer import Localizer
        from toolkit.localize.sequence import localize_sequence

        check_follows(self.settings)
        assert isinstance(self._method, Localizer)
        times = [photo.time for photo in photos]
        if any(time is None for time in times):
            untimed = next(photo.query.name for photo in photos if photo.time is None)
            raise DataError(
                f"Photo '{untimed}' has no time",
                expected="frames of the run's scene with the seconds at which they were taken",
                todo="Localise the photos one by one",
            )
        self._told.listen(silent)
        ordered = sorted(photos, key=lambda photo: photo.time or 0.0)
        queries: list[Query] = [photo.query for photo in ordered]
        found = localize_sequence(
            self._method,
            queries,
            sorted(time or 0.0 for time in times),
            start,
            settings,
            seed=seed,
            progress=progress,
        )
        return tuple(self._made(photo, start, one, seed) for photo, one in zip(ordered, found, strict=True))

    def _made(self, photo: Photo, start: Start, found: Localization, seed: int) -> LocalizedPhoto:
        return LocalizedPhoto(photo, start, found, self._method.name, self.settings.to_dict(), seed)


def run_scene(run: RunFolder) -> Scene:
    """Return a run's scene. Raises :class:`DataError` where it is missing or damaged."""
    from toolkit.scene.folder import read_scene

    with disk_errors(run.path, "reading"):
        return read_scene(run.scene_folder)


class _ToldMatcher:
    """A matcher that tells of every picture that it looks at: how many there will be nobody knows."""

    def __init__(self, matcher: PictureMatcher) -> None:
        self._matcher = matcher
        self._progress: Progress = silent
        self._seen = 0

    @property
    def method(self) -> str:
        return self._matcher.method

    def listen(self, progress: Progress) -> None:
        """Tell another listener, and count anew."""
        self._progress, self._seen = progress, 0

    def features(self, picture: Any) -> PictureFeatures:
        what = f"render {self._seen}" if self._seen else "photo"
        self._progress(ProgressEvent(STAGE, self._seen, None, what))
        self._seen += 1
        return self._matcher.features(picture)

    def match(self, one: PictureFeatures, other: PictureFeatures) -> PictureMatches:
        self._progress(ProgressEvent(STAGE, self._seen, None, f"matching render {max(self._seen - 1, 1)}"))
        return self._matcher.match(one, other)
