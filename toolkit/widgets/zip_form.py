"""Uploading a zip and unpacking it into a folder of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import panel as pn

from toolkit.errors import DataError, ToolkitError
from toolkit.progress import Progress
from toolkit.scene.new_folder import new_folder
from toolkit.scene.unzip import ZipLimits, unzip_captures
from toolkit.widgets.style import html_pane, notes
from toolkit.widgets.task import Task
from toolkit.widgets.upload import LARGEST_UPLOAD, ZipUpload


class ZipForm(pn.viewable.Viewer):
    """Name a folder, choose a zip: it is unpacked below the first data folder.

    Parameters
    ----------
    data_dirs:
        The capture goes into the first one.
    take:
        Called with the first capture that was in the zip.
    most:
        Bytes of the largest zip.
    limits:
        What may be in it.
    """

    def __init__(
        self,
        data_dirs: Sequence[Path],
        take: Callable[[Path], None],
        *,
        most: int = LARGEST_UPLOAD,
        limits: ZipLimits | None = None,
    ) -> None:
        super().__init__()
        self._take, self._limits = take, limits or ZipLimits()
        self._root = data_dirs[0] if data_dirs else None
        self.upload: ZipUpload | None = None
        self.task = Task()
        self._name = pn.widgets.TextInput(
            label="Name of its folder",
            placeholder="that of the file, where empty",
            width=260,
            margin=(4, 8),
        )
        about = html_pane(
            notes(
                [
                    f"Up to {most / 1e9:g} GB, and {self._limits.total_bytes / 1e9:g} GB in "
                    f"{self._limits.files:,} files when it is unpacked: photos, a folder with images/, or a whole "
                    "capture."
                ]
            )
        )
        parts: list[pn.viewable.Viewable | Task] = [about, self._name]
        if self._root is not None:
            self.upload = ZipUpload(self._root, take=self.unpack, refuse=self._refuse, most=most, margin=(4, 8))
            parts.append(self.upload)
        else:
            self.task.say("There is no data folder: name one when the page is started.", True)
        self._layout = pn.Column(*parts, self.task, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def unpack(self, name: str, archive: Path) -> None:
        """Unpack a zip that was uploaded under ``name``, and delete it."""
        try:
            if self._root is None:
                raise DataError("There is no data folder", todo="Name one when the page is started")
            folder = new_folder(self._root, (self._name.value or "").strip() or _folder_name(name))
        except ToolkitError as error:
            archive.unlink(missing_ok=True)
            self.task.say(str(error), True)
            return

        def work(progress: Progress) -> tuple[Path, ...]:
            try:
                return unzip_captures(archive, folder, limits=self._limits, progress=progress)
            finally:
                archive.unlink(missing_ok=True)

        self.task.begin(f"Unpacking {folder.name}", work, self._unpacked)

    def _unpacked(self, captures: tuple[Path, ...]) -> None:
        many = f", with {len(captures)} captures" if len(captures) > 1 else ""
        self.task.say(f"It is in {captures[0].parent if many else captures[0]}{many}.")
        self._name.value = ""
        self._take(captures[0])

    def _refuse(self, reason: str) -> None:
        if reason or not self.task.busy:
            self.task.say(reason, bool(reason))


def _folder_name(name: str) -> str:
    """Return a name for a folder from that of a file: what cannot be in one becomes a dash."""
    stem = name.replace("\\", "/").rpartition("/")[2].removesuffix(".zip").removesuffix(".ZIP")
    plain = "".join(
        letter if letter.isascii() and (letter.isalnum() or letter in "_-.") else "-" for letter in stem
    )
    return plain.strip("-.")[:60]
