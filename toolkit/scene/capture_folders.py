"""Finding captures below some folders, without opening a single picture."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError
from toolkit.scene import middlebury, strecha
from toolkit.scene.colmap_files import has_model
from toolkit.scene.folder import SCENE_FILE
from toolkit.scene.photos import ENDINGS
from toolkit.scene.raster_io import NITF_ENDINGS
from toolkit.scene.rpc_files import has_rpc_names
from toolkit.scene.transforms import TRANSFORMS_FILE

#: How far below a folder captures are looked for, and how many are listed.
DEEPEST, MOST = 4, 500


@dataclass(frozen=True, slots=True)
class CaptureFolder:
    """A folder that :func:`toolkit.scene.dataset.open_capture` should be able to open.

    Attributes
    ----------
    path:
        Resolved.
    root:
        The folder below which it was found, or which it is; resolved.
    layout:
        What tells how to read it: ``scene.json``, ``transforms.json``, ``satellite``, ``COLMAP``, ``EPFL``,
        ``Middlebury`` or ``photos``. Satellite pictures whose RPC is in their tags look like photos by their names.
    photos:
        How many files in its folder of pictures look like photos.
    """

    path: Path
    root: Path
    layout: str
    photos: int

    @property
    def label(self) -> str:
        """Its path below the folder in which it was found; the name of that one where it is itself the capture."""
        return self.path.relative_to(self.root).as_posix() if self.path != self.root else self.root.name


def find_captures(roots: Sequence[Path], *, deepest: int = DEEPEST, most: int = MOST) -> list[CaptureFolder]:
    """Return the captures at and below some folders, in order of their names.

    Only names are looked at, no picture is opened: what is damaged is told when the capture is opened. Folders in a
    capture are parts of it and not captures of their own. Hidden folders are passed over, and so are links: what
    they lead to may lie anywhere.

    Parameters
    ----------
    roots:
        Folders; those that are not there, or may not be read, have no captures.
    deepest:
        How many folders down to look.
    most:
        The search ends with so many.
    """
    found: dict[Path, CaptureFolder] = {}
    for root in dict.fromkeys(root.resolve() for root in roots):
        for capture in _below(root, root, deepest):
            found.setdefault(capture.path, capture)
            if len(found) >= most:
                return list(found.values())
    return list(found.values())


def require_below(path: Path, roots: Sequence[Path]) -> Path:
    """Return ``path`` with all links followed, where it lies in one of the folders.

    Raises
    ------
    DataError
        For a path that leads out of them.
    """
    resolved = path.resolve()
    if not any(resolved.is_relative_to(root.resolve()) for root in roots):
        raise DataError(
            f"{path} is not among the data",
            expected="a folder below " + (", ".join(map(str, roots)) or "a data folder, of which there is none"),
            todo="Put the data there, or name its folder when the page is started",
        )
    return resolved


def capture_folder(folder: Path, root: Path) -> CaptureFolder | None:
    """Return what kind of capture a folder is by the names in it, None where it is none or cannot be read."""
    try:
        entries = {entry.name: entry for entry in os.scandir(folder) if not entry.name.startswith(".")}
        images = "images" in entries and entries["images"].is_dir(follow_symlinks=False)
        photos = _count(folder / "images") if images else sum(map(_is_photo, entries))
        inside = [path.name for path in (folder / "images").iterdir()] if images else []
    except OSError:
        return None
    if SCENE_FILE in entries or TRANSFORMS_FILE in entries:
        layout = SCENE_FILE if SCENE_FILE in entries else TRANSFORMS_FILE
        return CaptureFolder(folder, root, layout, photos)
    if not photos:
        return None
    layout = "photos"
    if images and any(has_model(place) for place in (folder, folder / "sparse", folder / "sparse" / "0")):
        layout = "COLMAP"
    elif images and strecha.FOLDER in entries:
        layout = "EPFL"
    elif images and middlebury.parameter_file(folder) is not None:
        layout = "Middlebury"
    elif has_rpc_names([*entries, *inside]):
        layout = "satellite"
    return CaptureFolder(folder, root, layout, photos)


def _below(folder: Path, root: Path, deepest: int) -> Iterator[CaptureFolder]:
    capture = capture_folder(folder, root)
    if capture is not None:
        yield capture
        return
    if deepest == 0:
        return
    try:
        inner = sorted(
            entry.name
            for entry in os.scandir(folder)
            if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False)
        )
    except OSError:
        return
    for name in inner:
        yield from _below(folder / name, root, deepest - 1)


def _count(folder: Path) -> int:
    """Return the number of photos in a folder and the folders in it, not counting links to folders."""
    total = 0
    for _, inner, names in os.walk(folder):
        inner[:] = [name for name in inner if not name.startswith(".") and name != "masks"]
        total += sum(_is_photo(name) for name in names)
    return total


def _is_photo(name: str) -> bool:
    return not name.startswith(".") and Path(name).suffix.lower() in (*ENDINGS, *NITF_ENDINGS)
