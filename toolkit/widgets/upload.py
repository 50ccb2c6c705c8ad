"""A zip of photos from the browser to the disk, in parts that are acknowledged one by one.

The whole file is never in memory: a part is written as it comes, and the browser sends the next one when it hears
so. A part has to be smaller than a message of the web socket may be (Bokeh's ``websocket_max_message_size``, 20 MiB
unless the server says otherwise).
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import panel as pn
import param

from toolkit.errors import DataError, RunError, ToolkitError
from toolkit.files import disk_errors, require_free_space
from toolkit.widgets.style import SHEETS

#: Bytes of a part.
PART = 4 * 2**20
#: Bytes of the largest zip.
LARGEST_UPLOAD = 2 * 10**9
_PREFIX, _ENDING = ".upload-", ".zip"
#: Seconds after which a file that no page writes any more is deleted.
_ABANDONED = 24 * 3600
_LARGER = "Put larger captures into a data folder of the server"

_ESM = """
export function render({ model, el }) {
  el.style.width = "100%";
  el.innerHTML = `<label class="upload"><span></span><input type="file"></label>
    <progress max="1" value="0" hidden></progress> <button type="button" hidden>Cancel</button>`;
  const input = el.querySelector("input"), bar = el.querySelector("progress"), end = el.querySelector("button");
  el.querySelector("span").textContent = model.label;
  input.accept = model.accept;
  bar.setAttribute("aria-label", "Upload");
  let file = null, at = 0, number = 0;

  const rest = () => { file = null; bar.hidden = end.hidden = true; input.value = ""; input.disabled = false; };
  const send = async () => {
    const upload = number, from = at, source = file;
    let data;
    try {
      data = await source.slice(from, from + model.part).arrayBuffer();
    } catch (error) {
      if (upload === number) { model.send_msg({ kind: "failed", upload }); rest(); }
      return;
    }
    if (upload === number && file === source) model.send_msg({ kind: "part", upload, from, data });
  };
  input.addEventListener("change", () => {
    if (!input.files.length) return;
    file = input.files[0]; at = 0; number += 1;
    bar.value = 0; bar.hidden = end.hidden = false; input.disabled = true;
    model.send_msg({ kind: "begin", upload: number, name: file.name, size: file.size });
  });
  end.addEventListener("click", () => { model.send_msg({ kind: "failed", upload: number }); rest(); });
  model.on("msg:custom", (event) => {
    const heard = event.data ?? event;
    if (file === null || heard.upload !== number) return;
    if (heard.stop) { rest(); return; }
    at = heard.at;
    bar.value = file.size ? at / file.size : 1;
    if (at >= file.size) rest(); else send();
  });
}
"""
_SHEET = """
.upload { display: flex; flex-wrap: wrap; gap: 4px 12px; align-items: center; font-size: 14px; }
.upload input { font: inherit; color: var(--text); max-width: 100%; }
.upload input:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
[hidden] { display: none !important; }
progress { width: min(320px, 70%); height: 10px; accent-color: var(--accent); }
"""


class ZipUpload(pn.custom.JSComponent):
    """A field for a zip file. What arrives is a hidden file in a folder of the server.

    Parameters
    ----------
    folder:
        Where it is written; made when it is needed.
    take:
        Called with the file's own name and where it lies; it then belongs to the one who is called.
    refuse:
        Called with the reason, empty for none, where a file does not come.
    most:
        Bytes of the largest file.
    """

    label = param.String(default="Zip file")
    accept = param.String(default=".zip,application/zip")
    part = param.Integer(default=PART)

    _esm = _ESM
    #: What comes, for messages, and what is to be done where it is too large.
    _what, _larger = "a zip", _LARGER

    def __init__(
        self,
        folder: Path,
        *,
        take: Callable[[str, Path], None],
        refuse: Callable[[str], None],
        most: int = LARGEST_UPLOAD,
        **params: Any,
    ) -> None:
        super().__init__(stylesheets=[*SHEETS, _SHEET], sizing_mode="stretch_width", **params)
        self._receiver = Receiver(folder, most, self._what, self._larger)
        self._take, self._refuse = take, refuse

    def drop(self) -> None:
        """End the upload, as when the page is gone."""
        self._receiver.drop()

    def _handle_msg(self, data: Any) -> None:
        """Do what the browser says, and answer it."""
        upload = data.get("upload") if isinstance(data, Mapping) else None
        try:
            at = self._receiver.hear(data)
        except ToolkitError as error:
            self._refuse(str(error))
            self._send_msg({"upload": upload, "stop": True})
            return
        if at is None:
            self._refuse("The upload was cancelled.")
            return
        # Before the answer: what is said of the file comes first.
        finished = self._receiver.finished()
        if finished is not None:
            self._take(*finished)
        else:
            self._refuse("")
        self._send_msg({"upload": upload, "at": at})


class Receiver:
    """Writes the parts of one upload at a time, and trusts nothing that is said of them."""

    def __init__(self, folder: Path, most: int, what: str = "a zip", larger: str = _LARGER) -> None:
        self._folder, self._most = folder, most
        self._what, self._larger = what, larger
        self._file: BinaryIO | None = None
        self._path = folder
        self._name, self._upload = "", -1
        self._size = self._at = 0

    def hear(self, message: object) -> int | None:
        """Take one message; return how many bytes are there, None where the upload was ended.

        Raises
        ------
        DataError
            For a file that is too large or empty, or parts that do not follow each other; the upload is over then.
        RunError
            Where the disk is full or may not be written.
        """
        try:
            return self._take(message)
        except (ToolkitError, OSError) as error:
            self.drop()
            if isinstance(error, OSError):
                raise RunError(f"Cannot write the upload to {self._folder}", found=str(error)) from error
            raise

    def finished(self) -> tuple[str, Path] | None:
        """Return name and place of the file where all of it is there, None before."""
        if self._file is None or self._at < self._size:
            return None
        self._file.close()
        self._file = None
        return self._name, self._path

    def drop(self) -> None:
        """End the upload and delete what came."""
        if self._file is not None:
            self._file.close()
            self._path.unlink(missing_ok=True)
        self._file = None

    def _take(self, message: object) -> int | None:
        if not isinstance(message, Mapping):
            raise _out_of_order("no message")
        kind, upload = message.get("kind"), message.get("upload")
        if kind == "begin":
            self._begin(message)
            return 0
        if kind == "failed":
            self.drop()
            return None
        data = message.get("data")
        if self._file is None or kind != "part" or upload != self._upload or message.get("from") != self._at:
            raise _out_of_order(f"{kind!r:.20} of upload {upload!r:.20}")
        if not isinstance(data, bytes) or not 0 < len(data) <= self._size - self._at:
            raise _out_of_order("a part of the wrong size")
        with disk_errors(self._path, "uploading to"):
            self._file.write(data)
        self._at += len(data)
        return self._at

    def _begin(self, message: Mapping[Any, Any]) -> None:
        self.drop()
        name, size = message.get("name"), message.get("size")
        if not isinstance(name, str) or not isinstance(size, int) or isinstance(size, bool) or size < 0:
            raise _out_of_order("no name and size")
        if not 0 < size <= self._most:
            raise DataError(
                "This file cannot be uploaded",
                expected=f"{self._what} of up to {self._most / 1e6:,.0f} MB",
                found=f"{size / 1e6:,.1f} MB" if size else "an empty file",
                todo=self._larger,
            )
        with disk_errors(self._folder, "uploading to"):
            self._folder.mkdir(parents=True, exist_ok=True)
            remove_abandoned(self._folder)
            require_free_space(self._folder, "uploading to")
            self._path = self._folder / f"{_PREFIX}{uuid.uuid4().hex}{_ENDING}"
            self._file = self._path.open("xb")
        self._name, self._size, self._at, self._upload = name, size, 0, int(message.get("upload") or 0)


def remove_abandoned(folder: Path, seconds: float = _ABANDONED) -> int:
    """Delete uploads that nobody finished, and return their number."""
    removed = 0
    with os.scandir(folder) as entries:
        for entry in entries:
            ours = entry.name.startswith(_PREFIX) and entry.name.endswith(_ENDING)
            if ours and entry.is_file(follow_symlinks=False) and time.time() - entry.stat().st_mtime > seconds:
                Path(entry.path).unlink(missing_ok=True)
                removed += 1
    return removed


def _out_of_order(found: str) -> DataError:
    return DataError(
        "The upload came out of order", expected="its parts one after the other", found=found, todo="Send it again"
    )
