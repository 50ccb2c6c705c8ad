"""Archives of unknown origin: what is sound becomes a capture, all else is refused and leaves nothing behind."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import Cancelled, DataError, RunError
from toolkit.progress import ProgressEvent
from toolkit.scene.capture_folders import find_captures
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import write_scene
from toolkit.scene.new_folder import new_folder
from toolkit.scene.unzip import ZipLimits, unzip_captures

Write = Callable[[zipfile.ZipFile], None]
CENTRAL = b"PK\x01\x02"


def photo(seed: int = 0) -> bytes:
    memory = io.BytesIO()
    pixels = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(memory, "JPEG")
    return memory.getvalue()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    folder.mkdir()
    return folder


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    return tmp_path / "sent.zip"


def packed(archive: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files.items():
            opened.writestr(name, content)
    return archive


def left(root: Path) -> list[str]:
    """Return what lies in and beside the data folder."""
    return sorted(path.name for path in [*root.iterdir(), *root.parent.iterdir()] if path.name != "sent.zip")


def test_photos_become_a_capture(root: Path, archive: Path) -> None:
    files = {"images/": b"", "images/a.jpg": photo(1), "images/b.jpg": photo(2), "notes.txt": b"words"}
    events: list[ProgressEvent] = []
    found = unzip_captures(packed(archive, files), root / "new", progress=events.append)
    assert found == (root / "new",)
    assert (root / "new/images/a.jpg").read_bytes() == photo(1)
    assert (root / "new/notes.txt").read_bytes() == b"words"
    assert [capture.path for capture in find_captures([root])] == [root / "new"]
    told = [event for event in events if event.stage == "data.unzip"]
    assert told[-1].done == told[-1].total == sum(map(len, files.values()))


def test_captures_in_folders_are_found_and_hidden_files_left_out(root: Path, archive: Path) -> None:
    files = {
        "./": b"",
        "day/one/a.jpg": photo(1),
        "day/two/b.jpg": photo(2),
        "__MACOSX/day/one/._a.jpg": b"x",
        "day/.DS_Store": b"x",
    }
    found = unzip_captures(packed(archive, files), root / "new")
    assert found == (root / "new/day/one", root / "new/day/two")
    names = sorted(path.name for path in (root / "new").rglob("*"))
    assert names == ["a.jpg", "b.jpg", "day", "one", "two"]


@pytest.mark.parametrize(
    "name",
    [
        "/etc/evil.jpg",
        "../evil.jpg",
        "images/../../evil.jpg",
        "..",
        "C:/evil.jpg",
        "images\\..\\evil.jpg",
        "//h/e.jpg",
    ],
)
def test_paths_that_lead_out_are_refused(root: Path, archive: Path, name: str) -> None:
    # zipfile mends such names where it writes them.
    info = zipfile.ZipInfo("x")
    info.filename = name
    with zipfile.ZipFile(archive, "w") as opened:
        opened.writestr("images/a.jpg", photo())
        opened.writestr(info, photo())
    with pytest.raises(DataError, match="The zip was refused for .*; expected paths inside the folder"):
        unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


def test_a_name_with_a_zero_or_a_line_end_is_refused(root: Path, archive: Path) -> None:
    for letter in (b"\0", b"\n"):
        packed(archive, {"images/aQb.jpg": photo()})
        archive.write_bytes(archive.read_bytes().replace(b"aQb", b"a" + letter + b"b"))
        with pytest.raises(DataError, match="expected names without control characters"):
            unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


@pytest.mark.parametrize(("name", "found"), [("a" * 201 + ".jpg", "aaa"), ("a/" * 12 + "a.jpg", "a/a/a")])
def test_names_that_no_file_system_takes_are_refused(root: Path, archive: Path, name: str, found: str) -> None:
    with pytest.raises(DataError, match=f"expected 1 to 12 folders, each name up to 200 bytes; found '{found}"):
        unzip_captures(packed(archive, {name: photo()}), root / "new")
    assert left(root) == ["data"]


@pytest.mark.parametrize(
    ("kind", "found"), [(stat.S_IFLNK, "a link"), (stat.S_IFIFO, "a device or a pipe"), (stat.S_IFCHR, "a device")]
)
def test_links_and_devices_are_refused(root: Path, archive: Path, kind: int, found: str) -> None:
    info = zipfile.ZipInfo("images/link.jpg")
    info.external_attr = (kind | 0o777) << 16
    with zipfile.ZipFile(archive, "w") as opened:
        opened.writestr("images/a.jpg", photo())
        opened.writestr(info, "/etc/passwd")
    with pytest.raises(
        DataError, match=f"refused for 'images/link.jpg'; expected files and folders; found {found}"
    ):
        unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


def patched(archive: Path, offset: int, value: bytes) -> Path:
    """Change bytes of the first entry of the central directory."""
    content = bytearray(archive.read_bytes())
    start = content.index(CENTRAL) + offset
    content[start : start + len(value)] = value
    archive.write_bytes(bytes(content))
    return archive


def test_encrypted_files_are_refused(root: Path, archive: Path) -> None:
    patched(packed(archive, {"a.jpg": photo()}), 8, struct.pack("<H", 1))
    with pytest.raises(DataError, match="expected files without a password; found an encrypted one"):
        unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


def test_rare_methods_are_refused(root: Path, archive: Path) -> None:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_LZMA) as opened:
        opened.writestr("a.jpg", photo())
    with pytest.raises(DataError, match="expected files that are stored or deflated; found method 14"):
        unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


def test_a_bomb_is_refused_by_what_it_says_of_itself(root: Path, archive: Path) -> None:
    packed(archive, {"a.jpg": bytes(3_000_000)})
    assert archive.stat().st_size < 10_000
    with pytest.raises(DataError, match="too much; expected at most 2 MB unpacked; found 3 MB. Send it in parts"):
        unzip_captures(archive, root / "new", limits=ZipLimits(total_bytes=2_000_000))
    assert left(root) == ["data"]


def test_a_bomb_that_lies_about_its_size_is_cut_off(root: Path, archive: Path) -> None:
    # Central directory: 24 is the size when unpacked.
    patched(packed(archive, {"a.jpg": bytes(3_000_000)}), 24, struct.pack("<I", 1000))
    with pytest.raises(DataError, match="The zip is damaged, or none"):
        unzip_captures(archive, root / "new", limits=ZipLimits(total_bytes=2_000_000))
    assert left(root) == ["data"]


def test_too_many_files_are_refused(root: Path, archive: Path) -> None:
    packed(archive, {f"{number}.jpg": b"" for number in range(6)})
    with pytest.raises(DataError, match="expected at most 5 files; found 6"):
        unzip_captures(archive, root / "new", limits=ZipLimits(files=5))
    assert left(root) == ["data"]


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("a.jpg", "a.jpg"), "expected each name once, capitals or not; found a.jpg too"),
        (("a.jpg", "A.JPG"), "expected each name once, capitals or not; found a.jpg too"),
        (("a.jpg", "a.jpg/b.jpg"), "expected a file or a folder; found both"),
    ],
)
def test_names_that_clash_are_refused(root: Path, archive: Path, names: tuple[str, str], said: str) -> None:
    with zipfile.ZipFile(archive, "w") as opened:
        for name in names:
            opened.writestr(name, photo())
    with pytest.raises(DataError, match=said):
        unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


def test_what_is_no_whole_zip_is_refused(root: Path, archive: Path) -> None:
    archive.write_bytes(b"no zip at all")
    with pytest.raises(DataError, match="The zip is damaged, or none; expected a whole zip file"):
        unzip_captures(archive, root / "new")
    content = packed(archive, {"a.jpg": photo(1), "b.jpg": photo(2)}).read_bytes()
    for cut in (len(content) // 2, len(content) - 10):
        archive.write_bytes(content[:cut])
        with pytest.raises(DataError, match="The zip is damaged"):
            unzip_captures(archive, root / "new")
    damaged = bytearray(content)
    damaged[100:120] = bytes(20)
    archive.write_bytes(bytes(damaged))
    with pytest.raises(DataError, match="The zip is damaged"):
        unzip_captures(archive, root / "new")
    assert left(root) == ["data"]


def test_a_zip_without_a_capture_is_refused(root: Path, archive: Path) -> None:
    with pytest.raises(DataError, match=r"The zip is empty; expected pictures"):
        unzip_captures(packed(archive, {".hidden": b"x"}), root / "new")
    with pytest.raises(DataError, match=r"The zip holds no capture; .*; found a.txt, b.txt"):
        unzip_captures(packed(archive, {"a.txt": b"x", "b.txt": b"y"}), root / "new")
    with pytest.raises(DataError, match="is no picture"):
        unzip_captures(packed(archive, {"a.jpg": b"words"}), root / "new")
    assert left(root) == ["data"]


def test_a_scene_that_refers_to_pictures_of_the_machine_is_refused(
    root: Path, archive: Path, tmp_path: Path
) -> None:
    private = tmp_path / "private"
    private.mkdir()
    (private / "secret.jpg").write_bytes(photo())
    write_scene(open_capture(private).scene, tmp_path / "described")
    described = (tmp_path / "described/scene.json").read_bytes()
    assert str(private).encode() in described
    with pytest.raises(DataError, match=r"refers to private outside the data folders"):
        unzip_captures(packed(archive, {"scene.json": described}), root / "new")
    assert left(root) == ["data", "described", "private"]


def test_a_cancelled_unpacking_leaves_nothing(root: Path, archive: Path) -> None:
    def stop(event: ProgressEvent) -> None:
        if event.done:
            raise Cancelled("enough")

    packed(archive, {"a.jpg": photo(1), "b.jpg": photo(2)})
    with pytest.raises(Cancelled):
        unzip_captures(archive, root / "new", progress=stop)
    assert left(root) == ["data"]


def test_while_it_is_unpacked_nothing_is_found(root: Path, archive: Path) -> None:
    seen: list[int] = []
    packed(archive, {"a.jpg": photo(1), "b.jpg": photo(2)})
    unzip_captures(archive, root / "new", progress=lambda event: seen.append(len(find_captures([root]))))
    assert seen
    assert set(seen) == {0}


def test_a_folder_that_came_meanwhile_is_not_touched(root: Path, archive: Path) -> None:
    (root / "new").mkdir()
    (root / "new/mine.txt").write_text("mine")
    with pytest.raises((RunError, OSError)):
        unzip_captures(packed(archive, {"a.jpg": photo()}), root / "new")
    assert [path.name for path in (root / "new").iterdir()] == ["mine.txt"]
    assert left(root) == ["data", "new"]


@pytest.mark.parametrize(
    "name",
    [
        "",
        " ",
        ".",
        "..",
        "a/b",
        "../a",
        "a\\b",
        ".hidden",
        "-rf",
        "a" * 61,
        "a\nb",
        "con",
        "NUL.zip",
        "a.",
        "a..b",
        "ä",
    ],
)
def test_names_of_folders_are_one_plain_part(root: Path, name: str) -> None:
    with pytest.raises(DataError, match="The folder cannot have this name; expected 1 to 60 letters"):
        new_folder(root, name)


def test_names_that_are_taken_are_refused(root: Path) -> None:
    assert new_folder(root, "flight_2.b-c") == root / "flight_2.b-c"
    (root / "dead").symlink_to(root / "nowhere")
    (root / "taken").mkdir()
    for name in ("dead", "taken"):
        with pytest.raises(DataError, match=f"There is a {name} in .* already; expected a new name"):
            new_folder(root, name)
