"""Parts of a file from the browser: nothing that is said of them is trusted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from toolkit.errors import DataError, RunError
from toolkit.widgets import upload
from toolkit.widgets.upload import PART, Receiver, ZipUpload, remove_abandoned


def begin(size: object, name: object = "flight.zip", number: object = 1) -> dict[str, object]:
    return {"kind": "begin", "upload": number, "name": name, "size": size}


def part(at: object, data: object, number: object = 1) -> dict[str, object]:
    return {"kind": "part", "upload": number, "from": at, "data": data}


@pytest.fixture
def receiver(tmp_path: Path) -> Receiver:
    return Receiver(tmp_path / "data", 100)


def waiting(tmp_path: Path) -> list[Path]:
    return list((tmp_path / "data").glob(".*"))


def test_parts_become_a_hidden_file(receiver: Receiver, tmp_path: Path) -> None:
    assert receiver.hear(begin(8)) == 0
    assert receiver.hear(part(0, b"first")) == 5
    assert receiver.finished() is None
    assert receiver.hear(part(5, b"end")) == 8
    name, path = receiver.finished() or ("", Path())
    assert name == "flight.zip"
    assert path.read_bytes() == b"firstend"
    assert waiting(tmp_path) == [path]
    assert path.parent == tmp_path / "data"
    assert receiver.finished() is None  # it is told once


@pytest.mark.parametrize(("size", "found"), [(101, "0.0 MB"), (0, "an empty file"), (3 * 10**9, "3,000.0 MB")])
def test_sizes_are_limited(receiver: Receiver, tmp_path: Path, size: int, found: str) -> None:
    with pytest.raises(
        DataError, match=f"This file cannot be uploaded; expected a zip of up to 0 MB; found {found}"
    ):
        receiver.hear(begin(size))
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    "message",
    [
        part(0, b"x" * 9),  # more than was said
        part(4, b"x"),  # a hole
        part(0, b""),
        part(0, "text"),
        part(0, b"x", number=2),
        {"kind": "else"},
        "no message",
        None,
        begin("8"),
        begin(8, name=None),
        begin(True),
        begin(-1),
    ],
)
def test_what_is_out_of_order_ends_the_upload(receiver: Receiver, tmp_path: Path, message: object) -> None:
    receiver.hear(begin(8))
    assert len(waiting(tmp_path)) == 1
    with pytest.raises(DataError, match="The upload came out of order; .*Send it again"):
        receiver.hear(message)
    assert waiting(tmp_path) == []
    with pytest.raises(DataError, match="out of order"):
        receiver.hear(part(0, b"x"))


def test_a_cancelled_upload_and_one_that_begins_anew_leave_nothing(receiver: Receiver, tmp_path: Path) -> None:
    receiver.hear(begin(8))
    receiver.hear(part(0, b"first"))
    receiver.hear(begin(3, number=2))
    assert len(waiting(tmp_path)) == 1
    assert receiver.hear({"kind": "failed", "upload": 2}) is None
    assert waiting(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("a file")
    with pytest.raises(RunError):
        Receiver(tmp_path / "data", 100).hear(begin(8))


def test_abandoned_uploads_are_deleted(tmp_path: Path) -> None:
    for name, age in (
        (".upload-a.zip", 90_000),
        (".upload-b.zip", 10),
        (".hidden.zip", 90_000),
        ("own.zip", 90_000),
    ):
        path = tmp_path / name
        path.write_bytes(b"x")
        os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age))
    assert remove_abandoned(tmp_path) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden.zip", ".upload-b.zip", "own.zip"]


def test_a_part_fits_into_a_message_of_the_web_socket() -> None:
    from bokeh.server.tornado import DEFAULT_WEBSOCKET_MAX_MESSAGE_SIZE_BYTES

    assert PART + 100_000 < DEFAULT_WEBSOCKET_MAX_MESSAGE_SIZE_BYTES


def test_the_field_answers_each_part_and_hands_the_file_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[Any] = []
    taken: list[tuple[str, bytes]] = []
    refused: list[str] = []
    field = ZipUpload(
        tmp_path, take=lambda name, path: taken.append((name, path.read_bytes())), refuse=refused.append, most=100
    )
    monkeypatch.setattr(field, "_send_msg", answers.append)
    for message in (begin(4), part(0, b"ab"), part(2, b"cd")):
        field._handle_msg(message)
    assert answers == [{"upload": 1, "at": at} for at in (0, 2, 4)]
    assert taken == [("flight.zip", b"abcd")]
    assert set(refused) == {""}
    field._handle_msg(begin(1000, number=2))
    assert answers[-1] == {"upload": 2, "stop": True}
    assert "cannot be uploaded" in refused[-1]
    field._handle_msg(begin(5, number=3))
    field._handle_msg({"kind": "failed", "upload": 3})
    assert refused[-1] == "The upload was cancelled."
    assert answers[-1] == {"upload": 3, "at": 0}


def test_the_largest_upload_is_two_gigabytes() -> None:
    assert upload.LARGEST_UPLOAD == 2 * 10**9
