"""Data sets come into a data folder whole or not at all, and half of one is never found as a capture."""

from __future__ import annotations

import hashlib
import http.server
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from toolkit.errors import Cancelled, DataError, RunError
from toolkit.progress import ProgressEvent
from toolkit.samples.data_folder import fetch_into, locate_in
from toolkit.samples.data_set import DataFile, DataSet
from toolkit.scene.capture_folders import find_captures

BODIES = {"images/a.jpg": b"a picture" * 20_000, "images/b.jpg": b"another"}


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = BODIES[self.path.lstrip("/")]
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        with suppress(BrokenPipeError, ConnectionResetError):  # one that cancels hangs up
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@pytest.fixture
def data_set(monkeypatch: pytest.MonkeyPatch) -> Iterator[DataSet]:
    monkeypatch.delenv("TOOLKIT_DATA", raising=False)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        base = f"http://127.0.0.1:{server.server_address[1]}/"
        files = {
            path: DataFile(base + path, hashlib.sha256(body).hexdigest(), len(body))
            for path, body in BODIES.items()
        }
        yield DataSet("small_set", "A small set", base, None, "none", "", files, local="small_set")
        server.shutdown()
        thread.join()


def test_a_set_comes_into_the_folder(data_set: DataSet, tmp_path: Path) -> None:
    seen: list[int] = []

    def look(event: ProgressEvent) -> None:
        seen.append(len(find_captures([tmp_path])))

    assert locate_in(data_set, [tmp_path]) is None
    assert fetch_into(data_set, tmp_path, progress=look) == tmp_path / "small_set"
    assert set(seen) == {0}
    assert {path: (tmp_path / "small_set" / path).read_bytes() for path in BODIES} == BODIES
    assert [capture.path for capture in find_captures([tmp_path])] == [tmp_path / "small_set"]
    assert locate_in(data_set, [tmp_path / "empty", tmp_path]) == tmp_path / "small_set"
    assert fetch_into(data_set, tmp_path) == tmp_path / "small_set"


def test_a_cancelled_fetch_goes_on_later(data_set: DataSet, tmp_path: Path) -> None:
    def stop(event: ProgressEvent) -> None:
        if event.message == "images/b.jpg":
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        fetch_into(data_set, tmp_path, progress=stop)
    assert find_captures([tmp_path]) == []
    assert locate_in(data_set, [tmp_path]) is None
    fetch_into(data_set, tmp_path)
    assert locate_in(data_set, [tmp_path]) is not None


def test_what_is_in_the_way_is_left_alone(data_set: DataSet, tmp_path: Path) -> None:
    (tmp_path / "small_set").mkdir()
    with pytest.raises(RunError, match=r"small_set is in the way; expected nothing there"):
        fetch_into(data_set, tmp_path)


def test_a_set_by_hand_says_how(data_set: DataSet, tmp_path: Path) -> None:
    import dataclasses

    by_hand = dataclasses.replace(data_set, files={}, how_to_get="Ask the authors")
    with pytest.raises(DataError, match=r"cannot be downloaded; .*Ask the authors"):
        fetch_into(by_hand, tmp_path)


def test_a_set_where_toolkit_data_says_is_used(
    data_set: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "given/small_set").mkdir(parents=True)
    monkeypatch.setenv("TOOLKIT_DATA", str(tmp_path / "given"))
    assert fetch_into(data_set, tmp_path / "new") == tmp_path / "given/small_set"
    assert locate_in(data_set, [tmp_path / "new"]) == tmp_path / "given/small_set"
