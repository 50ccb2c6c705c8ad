"""The registry of public data sets: sound entries, and downloads that are whole and verified or refused."""

from __future__ import annotations

import hashlib
import http.server
import json
import re
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import filelock
import pooch
import pytest

from toolkit.errors import Cancelled, DataError, RunError, SettingsError
from toolkit.progress import ProgressEvent
from toolkit.samples import registry
from toolkit.samples.data_set import MARKER, DataFile, DataSet, read_registry
from toolkit.samples.registry import data_sets, default_cache, fetch, find_data_set, locate
from toolkit.samples.registry_text import data_sets_text, size_text

BODIES = {"a.txt": b"first file", "sub/b.bin": bytes(range(256)) * 2000, "c.txt": b"last file"}


class Server(http.server.ThreadingHTTPServer):
    """Serves ``BODIES`` from memory and remembers what it was asked for."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.bodies = dict(BODIES)
        self.truncated: set[str] = set()
        self.asked: list[str] = []

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        name = self.path.lstrip("/")
        self.server.asked.append(name)
        body = self.server.bodies.get(name)
        if body is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        # A cancelled client hangs up: that is what some tests are about.
        with suppress(BrokenPipeError, ConnectionResetError):
            self.wfile.write(body[: len(body) // 2] if name in self.server.truncated else body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("real") is None:
        monkeypatch.delenv("TOOLKIT_DATA", raising=False)
    monkeypatch.delenv("TOOLKIT_CACHE", raising=False)


def sample(server: Server, **changes: object) -> DataSet:
    files = {
        path: DataFile(server.address + path, hashlib.sha256(body).hexdigest(), len(body))
        for path, body in BODIES.items()
    }
    whole = DataSet(
        "sample",
        "A sample",
        "https://example.org",
        "0" * 40,
        "MIT",
        "Nobody",
        files,
        local="sample_here",
        notes="None",
    )
    return replace(whole, **changes)


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != MARKER)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_every_entry_says_what_a_user_must_know() -> None:
    sets = data_sets()
    assert len(sets) >= 20
    for name, data_set in sets.items():
        assert name == data_set.name
        assert all((data_set.title, data_set.source, data_set.licence, data_set.citation, data_set.notes)), name
        if data_set.by_hand:
            assert data_set.local is not None, name
            assert "TOOLKIT_DATA" in data_set.how_to_get, name
        else:
            assert re.fullmatch(r"https://github\.com/[\w.-]+/[\w.-]+", data_set.source), name
            assert re.fullmatch(r"[0-9a-f]{40}", data_set.commit or ""), name
        for path, file in data_set.files.items():
            assert re.match(r"https://raw\.githubusercontent\.com/[\w.-]+/[\w.-]+/[0-9a-f]{40}/", file.url), path
            assert (file.sha256 is None) == (file.size is None), path
        if data_set.unverified:
            assert re.search(rf"hash is not known of {len(data_set.unverified)}\b", data_set.notes), name


def test_the_papers_own_sets_are_told_by_hand() -> None:
    by_hand = {name for name, data_set in data_sets().items() if data_set.by_hand}
    assert by_hand == {"jb3d", "nordic", "tmb_ipf", "dfc2019_track3", "mars_lvig"}


@pytest.mark.real
def test_every_local_set_is_below_the_data_folder(real_data: Path) -> None:
    local = {data_set.local for data_set in data_sets().values() if data_set.local and not data_set.by_hand}
    assert local <= {path.name for path in real_data.iterdir() if path.is_dir()}
    assert len(local) == 15
    assert locate("slam_trajectories") == real_data / "slam_trajectories"


@pytest.mark.real
@pytest.mark.parametrize("name", ["slam_trajectories", "nvs_gsplat_garden", "sat_pleiades_s2p", "sat_rpc_shareloc"])
def test_copies_that_are_unchanged_have_the_registry_hashes(real_data: Path, name: str) -> None:
    for path, file in find_data_set(name).files.items():
        found = hashlib.sha256((real_data / name / path).read_bytes()).hexdigest()
        assert found == file.sha256, path


def test_an_unknown_name_gets_the_closest_ones() -> None:
    with pytest.raises(
        SettingsError, match=r"There is no data set 'strecha_fountain'.*Did you mean strecha_fountain_p11"
    ):
        find_data_set("strecha_fountain")


def test_a_set_arrives_whole_with_its_marker(server: Server, tmp_path: Path) -> None:
    data_set, events = sample(server), list[ProgressEvent]()
    assert locate(data_set, cache=tmp_path) is None
    folder = fetch(data_set, cache=tmp_path, progress=events.append)
    assert folder == tmp_path / "sample" == locate(data_set, cache=tmp_path)
    assert content(folder) == BODIES
    record = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    assert (record["name"], record["licence"], record["commit"]) == ("sample", "MIT", "0" * 40)
    assert not (tmp_path / "sample.part").exists()
    done = [event.done for event in events]
    assert done == sorted(done)
    assert (done[0], done[-1]) == (0, sum(map(len, BODIES.values())))
    assert {event.total for event in events} == {done[-1]}
    assert len(done) > 8, "a large file is told about while it arrives"


def test_what_is_there_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    fetch(sample(server), cache=tmp_path)
    server.asked.clear()
    fetch(sample(server), cache=tmp_path)
    assert server.asked == []


def test_a_changed_registry_fetches_only_what_changed(server: Server, tmp_path: Path) -> None:
    old = sample(server)
    fetch(old, cache=tmp_path)
    server.asked.clear()
    server.bodies["a.txt"] = b"second edition"
    file = DataFile(server.address + "a.txt", hashlib.sha256(b"second edition").hexdigest(), 14)
    new = sample(server, files={**old.files, "a.txt": file})
    assert locate(new, cache=tmp_path) is None
    assert content(fetch(new, cache=tmp_path))["a.txt"] == b"second edition"
    assert server.asked == ["a.txt"]


def test_a_wrong_hash_is_refused_and_nothing_shows(server: Server, tmp_path: Path) -> None:
    server.bodies["c.txt"] = b"tampered!"
    tampered = hashlib.sha256(b"tampered!").hexdigest()
    with pytest.raises(
        DataError, match=rf"c.txt of data set 'sample' is not what the registry lists.*found {tampered}"
    ) as e:
        fetch(sample(server), cache=tmp_path)
    assert f"expected SHA-256 {hashlib.sha256(BODIES['c.txt']).hexdigest()}" in str(e.value)
    assert "TOOLKIT_DATA point to a folder that holds a copy as sample_here" in str(e.value)
    assert not (tmp_path / "sample").exists()
    assert not (tmp_path / "sample.part" / "c.txt").exists()


def test_a_missing_file_names_its_address_and_status(server: Server, tmp_path: Path) -> None:
    del server.bodies["a.txt"]
    with pytest.raises(
        DataError, match=r"Cannot download a.txt of data set 'sample'; expected http.*a.txt; found 404"
    ):
        fetch(sample(server), cache=tmp_path)


def test_a_truncated_body_is_refused(server: Server, tmp_path: Path) -> None:
    server.truncated.add("sub/b.bin")
    with pytest.raises(DataError, match=r"Cannot download sub/b.bin .*found .*256000"):
        fetch(sample(server), cache=tmp_path)
    assert list((tmp_path / "sample.part").rglob("b.bin")) == []


def test_no_network_is_told(server: Server, tmp_path: Path) -> None:
    data_set = sample(server)
    server.server_close()
    with pytest.raises(DataError, match=r"Cannot download a.txt .*what is complete is kept"):
        fetch(data_set, cache=tmp_path)


def test_a_cancelled_download_goes_on_where_it_stopped(server: Server, tmp_path: Path) -> None:
    def cancel_in_the_middle(event: ProgressEvent) -> None:
        if event.message == "sub/b.bin" and event.done > 100_000:
            raise Cancelled("Enough")

    with pytest.raises(Cancelled):
        fetch(sample(server), cache=tmp_path, progress=cancel_in_the_middle)
    assert locate(sample(server), cache=tmp_path) is None
    assert content(tmp_path / "sample.part") == {"a.txt": BODIES["a.txt"]}
    (tmp_path / "sample.part" / "tmpkilled").write_bytes(b"left by a killed process")
    server.asked.clear()
    assert content(fetch(sample(server), cache=tmp_path)) == BODIES
    assert server.asked == ["sub/b.bin", "c.txt"]


def test_a_set_that_must_be_asked_for_says_how(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"'jb3d' is not on this machine and cannot be downloaded.*ask the authors.*mp4"
    ):
        fetch("jb3d", cache=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_unknown_hashes_are_refused_unless_allowed(server: Server, tmp_path: Path) -> None:
    data_set = sample(server)
    doubtful = replace(
        data_set, files={**data_set.files, "a.txt": replace(data_set.files["a.txt"], sha256=None, size=None)}
    )
    with pytest.raises(
        DataError, match=r"found none for 1 of 3, the first being a.txt\. Pass allow_unverified=True"
    ):
        fetch(doubtful, cache=tmp_path)
    assert server.asked == []
    events: list[ProgressEvent] = []
    folder = fetch(doubtful, cache=tmp_path, allow_unverified=True, progress=events.append)
    assert content(folder) == BODIES
    assert json.loads((folder / MARKER).read_text(encoding="utf-8"))["unverified"] == ["a.txt"]
    assert {event.total for event in events} == {None}


def test_the_data_folder_comes_first(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, cache = tmp_path / "data", tmp_path / "cache"
    (data / "sample_here").mkdir(parents=True)
    fetched = fetch(sample(server), cache=cache)
    monkeypatch.setenv("TOOLKIT_DATA", str(data))
    assert locate(sample(server), cache=cache) == data / "sample_here"
    assert fetch(sample(server), cache=cache) == data / "sample_here"
    assert locate(sample(server, local="elsewhere"), cache=cache) == fetched
    monkeypatch.setenv("TOOLKIT_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match=r"TOOLKIT_DATA names no folder.*nowhere"):
        locate(sample(server), cache=cache)


def test_the_cache_is_where_the_environment_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert default_cache().name == "sightline-toolkit"
    monkeypatch.setenv("TOOLKIT_CACHE", str(tmp_path))
    assert default_cache() == tmp_path


def test_what_is_in_the_way_is_left_alone(server: Server, tmp_path: Path) -> None:
    (tmp_path / "sample").mkdir()
    (tmp_path / "sample" / "mine.txt").write_text("mine")
    with pytest.raises(RunError, match=r"sample is in the way.*Move it away"):
        fetch(sample(server), cache=tmp_path)
    assert (tmp_path / "sample" / "mine.txt").read_text() == "mine"


def test_two_processes_do_not_fetch_the_same_set(server: Server, tmp_path: Path) -> None:
    with (
        filelock.FileLock(tmp_path / ".sample.lock"),
        pytest.raises(RunError, match=r"Another process is fetching 'sample'"),
    ):
        fetch(sample(server), cache=tmp_path)


def test_a_full_disk_is_told_before_anything_is_asked_for(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, doing: str) -> None:
        raise RunError(f"The disk is full while {doing} {path}")

    monkeypatch.setattr(registry, "require_free_space", full)
    with pytest.raises(RunError, match=r"The disk is full while fetching into"):
        fetch(sample(server), cache=tmp_path)
    assert server.asked == []


def test_pooch_is_quiet_and_its_logger_is_left_as_it_was(
    server: Server, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    logger = pooch.get_logger()
    before = logger.level
    fetch(sample(server), cache=tmp_path)
    assert capfd.readouterr() == ("", "")
    assert logger.level == before


@pytest.mark.parametrize(
    "path", ["../out.txt", "/etc/out.txt", "a/../../b", "a\\b", "C:out", "", ".", "a//b", MARKER]
)
def test_paths_never_leave_the_folder(path: str) -> None:
    with pytest.raises(DataError, match=r"is not inside the data set's folder; expected a relative path"):
        DataSet("x", "t", "s", None, "l", "c", {path: DataFile("https://example.org/x", None, None)})


@pytest.mark.parametrize("url", ["http://example.org/x", "file:///etc/passwd", "ftp://example.org/x", "x"])
def test_only_safe_addresses_are_taken(url: str) -> None:
    with pytest.raises(DataError, match=r"the address is not safe; expected https://"):
        DataSet("x", "t", "s", None, "l", "c", {"x": DataFile(url, None, None)})


def test_broken_entries_are_told() -> None:
    good = DataFile("https://example.org/x", None, None)
    with pytest.raises(DataError, match=r"no SHA-256; expected 64 hexadecimal digits, or null; found 'abc'"):
        DataSet("x", "t", "s", None, "l", "c", {"x": replace(good, sha256="abc")})
    with pytest.raises(DataError, match=r"no size; expected a number of bytes"):
        DataSet("x", "t", "s", None, "l", "c", {"x": replace(good, size=-1)})
    with pytest.raises(DataError, match=r"'name' is no plain folder name.*found '\.\./x'"):
        DataSet("../x", "t", "s", None, "l", "c", {"x": good})
    with pytest.raises(DataError, match=r"'local' is no plain folder name"):
        DataSet("x", "t", "s", None, "l", "c", {"x": good}, local="..")
    with pytest.raises(DataError, match=r"cannot be had; expected files, or how_to_get"):
        DataSet("x", "t", "s", None, "l", "c", {})


ENTRY = {"name": "x", "title": "", "source": "", "licence": "", "citation": "", "how_to_get": "ask", "notes": ""}


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ([], "is no registry of data sets; expected format 1"),
        ({"format": 2, "data_sets": []}, "is no registry of data sets"),
        ({"format": 1, "data_sets": ["x"]}, "entry 1 is no object"),
        ({"format": 1, "data_sets": [{"name": "x"}]}, "'title' is missing; expected a text; found None"),
        ({"format": 1, "data_sets": [ENTRY]}, "'files' is missing"),
        ({"format": 1, "data_sets": [{**ENTRY, "files": {"a": {}}}]}, "file 'a' has no address"),
        ({"format": 1, "data_sets": [{**ENTRY, "files": {}}] * 2}, "lists 'x' twice"),
    ],
)
def test_a_broken_registry_is_told(tmp_path: Path, record: object, message: str) -> None:
    path = tmp_path / "registry.json"
    path.write_text(json.dumps(record))
    with pytest.raises(DataError, match=message):
        read_registry(path)


def test_addresses_may_be_relative_to_the_base(tmp_path: Path) -> None:
    path = tmp_path / "registry.json"
    entry = {
        **ENTRY,
        "base": "https://example.org/r/1/",
        "files": {"a": {"url": "d/a"}, "b": {"url": "https://b.org/b"}},
    }
    path.write_text(json.dumps({"format": 1, "data_sets": [entry]}))
    files = read_registry(path)["x"].files
    assert (files["a"].url, files["b"].url) == ("https://example.org/r/1/d/a", "https://b.org/b")


def test_the_table_tells_what_is_here(server: Server, tmp_path: Path) -> None:
    here = sample(server)
    fetch(here, cache=tmp_path)
    doubtful = replace(here.files["a.txt"], sha256=None, size=None)
    sets = [
        here,
        sample(server, name="away", title="A long title " * 10),
        sample(server, name="doubtful", files={"a": doubtful}),
        sample(server, name="asked", files={}, how_to_get="Ask"),
    ]
    header, *rows = data_sets_text(sets, cache=tmp_path).splitlines()
    assert header.split() == ["name", "size", "state", "title", "licence"]
    assert re.fullmatch(r"sample +0\.5 MB +here +A sample +MIT", rows[0])
    assert re.fullmatch(r"away +0\.5 MB +can be fetched +A long title .*\.\.\. +MIT", rows[1])
    assert re.fullmatch(r"doubtful +not known +can be fetched, unverified +A sample +MIT", rows[2])
    assert re.fullmatch(r"asked +not known +by hand +A sample +MIT", rows[3])
    assert size_text(2048) == "2.0 kB"
