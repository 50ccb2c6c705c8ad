"""What is where in the data sets of the papers, as their publishers lay them out.

Nothing is read but names and the four numbers of a surface model's frame: pictures, videos and bags are opened by
whoever needs them.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError

_VIEW = re.compile(r"(?P<site>(?:JAX|OMA)_\d{3})_(?P<number>\d{3})_(?P<kind>RGB|MSI)\.tif")
_TRUTH = re.compile(r"(?P<site>(?:JAX|OMA)_\d{3})_(?P<kind>DSM\.tif|DSM\.txt|CLS\.tif)")
_VIDEOS = (".mp4", ".mov")
_TELEMETRY = (".srt", ".csv", ".gpx")
_SEQUENCE = re.compile(
    r"(?:interval\d+_)?(?P<name>(?:AMtown|AMvalley|(?:HKairport|HKisland)(?:_GNSS)?|Featureless_GNSS)(?:\d\d|_Evening))"
)
_PICTURES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, slots=True)
class SurfaceFrame:
    """Where the grid of a surface model lies.

    Attributes
    ----------
    easting, northing:
        UTM coordinates of its lower left (south-west) corner in metres.
    size:
        Cells along each side.
    ground_sample_distance:
        Side of a cell in metres.
    """

    easting: float
    northing: float
    size: int
    ground_sample_distance: float


@dataclass(frozen=True, slots=True)
class SatelliteView:
    """One satellite picture of a site: the colour and the multispectral file, where they are there."""

    number: int
    rgb: Path | None
    msi: Path | None


@dataclass(frozen=True, slots=True)
class SatelliteSite:
    """A scene of DFC2019 Track 3.

    Attributes
    ----------
    name:
        City and tile, for example ``JAX_004``.
    views:
        In order of their number.
    surface, frame, classes:
        Lidar surface model, its frame and the classes of its cells; None where the file is missing.
    missing:
        Names of the truth files that are missing.
    """

    name: str
    views: tuple[SatelliteView, ...]
    surface: Path | None
    frame: SurfaceFrame | None
    classes: Path | None
    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class VideoFlight:
    """A flight: its name (the path below the folder without the suffix), its video and its telemetry, if any."""

    name: str
    video: Path
    telemetry: Path | None


@dataclass(frozen=True, slots=True)
class AerialSequence:
    """A sequence of MARS-LVIG.

    Attributes
    ----------
    name:
        For example ``AMtown01``.
    bag:
        The ROS bag; None where only what was extracted is there.
    images:
        In order of their names; empty where none were extracted.
    rtk:
        Text or CSV file of RTK positions; None where none was extracted.
    """

    name: str
    bag: Path | None
    images: tuple[Path, ...]
    rtk: Path | None


def find_dfc2019(folder: Path) -> tuple[SatelliteSite, ...]:
    """Return the scenes of the 2019 Data Fusion Contest, Track 3, that lie below ``folder``.

    Expected are ``Track3-RGB-*/JAX_004_006_RGB.tif``, ``Track3-MSI-*/JAX_004_006_MSI.tif`` and
    ``Track3-Truth/JAX_004_{DSM.tif,DSM.txt,CLS.tif}``; a folder more or less on the way does not matter. Truth of
    sites without pictures is left out: its archive covers both cities.

    Raises
    ------
    DataError
        When there are no such pictures, the same one lies in two places, or a ``DSM.txt`` is not four numbers.
    """
    views: dict[str, dict[int, dict[str, Path]]] = defaultdict(lambda: defaultdict(dict))
    truth: dict[str, dict[str, Path]] = defaultdict(dict)
    for path in _files(folder):
        if match := _VIEW.fullmatch(path.name):
            _put(views[match["site"]][int(match["number"])], match["kind"], path)
        elif match := _TRUTH.fullmatch(path.name):
            _put(truth[match["site"]], match["kind"], path)
    if not views:
        raise DataError(
            f"No DFC2019 Track 3 pictures below {folder}",
            expected="files like Track3-RGB-1/JAX_004_006_RGB.tif",
            found=f"truth of {len(truth)} sites only" if truth else "none",
            todo="Unpack the Track 3 archives with the pictures (RGB or MSI) into it",
        )
    return tuple(_site(name, views[name], truth.get(name, {})) for name in sorted(views))


def find_flights(folder: Path) -> tuple[VideoFlight, ...]:
    """Return the drone videos below ``folder`` with their telemetry (the layout for JB3D, Nordic and TMB-IPF).

    A flight is one ``*.mp4`` or ``*.mov``; its telemetry is the ``*.srt``, ``*.csv`` or ``*.gpx`` of the same name
    beside it. Upper and lower case of the suffix do not matter.

    Raises
    ------
    DataError
        When there is no video, or two videos or two telemetry files share a name.
    """
    videos: dict[Path, list[Path]] = defaultdict(list)
    telemetry: dict[Path, list[Path]] = defaultdict(list)
    for path in _files(folder):
        suffix = path.suffix.lower()
        if suffix in _VIDEOS:
            videos[path.with_suffix("")].append(path)
        elif suffix in _TELEMETRY:
            telemetry[path.with_suffix("")].append(path)
    if not videos:
        raise DataError(
            f"No videos below {folder}",
            expected="one video (*.mp4 or *.mov) a flight, its telemetry (*.srt, *.csv or *.gpx) beside it",
            found=f"{len(telemetry)} telemetry files only" if telemetry else "none",
        )
    return tuple(
        VideoFlight(
            stem.relative_to(folder).as_posix(),
            _only(f"Flight {stem}", "video", videos[stem]),
            _only(f"Flight {stem}", "telemetry file", telemetry[stem]) if stem in telemetry else None,
        )
        for stem in sorted(videos)
    )


def find_mars_lvig(folder: Path) -> tuple[AerialSequence, ...]:
    """Return the sequences of MARS-LVIG below ``folder``.

    Expected are the bags as published (``AMtown01.bag``), and what was extracted from one in a folder ``AMtown01``
    (or ``interval5_AMtown01``): pictures in it or in one folder in it (then those beside that folder are taken
    for plots), and a ``.txt`` or ``.csv`` whose name
    contains ``rtk``.

    Raises
    ------
    DataError
        When there is no sequence, or it is not clear which bag, pictures or positions are meant.
    """
    bags: dict[str, list[Path]] = defaultdict(list)
    images: dict[str, dict[Path, list[Path]]] = defaultdict(lambda: defaultdict(list))
    rtk: dict[str, list[Path]] = defaultdict(list)
    for path in _files(folder):
        match = _SEQUENCE.fullmatch(path.stem)
        if path.suffix == ".bag" and match:
            bags[match["name"]].append(path)
            continue
        name = _sequence_of(path.relative_to(folder), folder.name)
        if name is not None and path.suffix.lower() in _PICTURES:
            images[name][path.parent].append(path)
        elif name is not None and path.suffix.lower() in (".txt", ".csv") and "rtk" in path.stem.lower():
            rtk[name].append(path)
    names = sorted({*bags, *images, *rtk})
    if not names:
        raise DataError(
            f"No MARS-LVIG sequences below {folder}",
            expected="bags like AMtown01.bag, or a folder AMtown01 with pictures and a text file of RTK positions",
            found="none",
        )
    return tuple(
        AerialSequence(
            name,
            _only(f"Sequence {name}", "bag", bags[name]) if name in bags else None,
            _pictures(name, images[name]) if name in images else (),
            _only(f"Sequence {name}", "file of RTK positions", rtk[name]) if name in rtk else None,
        )
        for name in names
    )


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files below ``folder`` in order, without hidden ones (macOS leaves ``._*`` beside videos)."""
    if not folder.is_dir():
        raise DataError(f"{folder} is no folder", expected="the folder that holds the data set")
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith("."):
            yield path


def _put(places: dict[str, Path], kind: str, path: Path) -> None:
    if kind in places:
        raise _ambiguous(path.name, "file", (places[kind], path))
    places[kind] = path


def _only(owner: str, what: str, paths: Iterable[Path]) -> Path:
    several = list(paths)
    if len(several) > 1:
        raise _ambiguous(owner, what, several)
    return several[0]


def _ambiguous(owner: str, what: str, paths: Iterable[Path]) -> DataError:
    return DataError(
        f"{owner} is ambiguous",
        expected=f"one {what}",
        found=" and ".join(str(path) for path in paths),
        todo="Keep one of them below this folder, or name a folder that holds only one",
    )


def _site(name: str, views: dict[int, dict[str, Path]], truth: dict[str, Path]) -> SatelliteSite:
    return SatelliteSite(
        name,
        tuple(
            SatelliteView(number, views[number].get("RGB"), views[number].get("MSI")) for number in sorted(views)
        ),
        truth.get("DSM.tif"),
        _read_frame(truth["DSM.txt"]) if "DSM.txt" in truth else None,
        truth.get("CLS.tif"),
        tuple(f"{name}_{kind}" for kind in ("DSM.tif", "DSM.txt", "CLS.tif") if kind not in truth),
    )


def _read_frame(path: Path) -> SurfaceFrame:
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if (
        len(numbers) != 4
        or not all(map(math.isfinite, numbers))
        or numbers[2] != int(numbers[2])
        or min(numbers[2:]) <= 0
    ):
        raise DataError(
            f"{path} is no frame of a surface model",
            expected="four numbers: easting, northing, size in cells, ground sample distance in metres",
            found=repr(text[:80]),
        )
    return SurfaceFrame(numbers[0], numbers[1], int(numbers[2]), numbers[3])


def _pictures(name: str, folders: dict[Path, list[Path]]) -> tuple[Path, ...]:
    """Return the pictures of a sequence; those beside the folder of pictures are plots, and left out."""
    inner = [folder for folder in folders if not any(folder in other.parents for other in folders)]
    return tuple(folders[_only(f"Sequence {name}", "folder of pictures", inner)])


def _sequence_of(path: Path, top: str) -> str | None:
    """Return the sequence that a file was extracted from: the nearest folder around it that is called like one."""
    for part in (*reversed(path.parts[:-1]), top):
        if match := _SEQUENCE.fullmatch(part):
            return match["name"]
    return None
