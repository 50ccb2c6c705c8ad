"""Vocabularies: trained ones are sound and repeat, damaged ones are refused before ORB-SLAM3 meets them."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from toolkit.cli import main
from toolkit.errors import Cancelled, DataError, MissingDependencyError
from toolkit.poses.slam.hamming import hamming
from toolkit.poses.slam.vocabulary import VocabularySettings, pictures_below, train_vocabulary
from toolkit.poses.slam.vocabulary_file import check_vocabulary
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.samples import SampleSettings, make_sample

SMALL = VocabularySettings(branches=4, levels=5, features=300)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    pytest.importorskip("cv2", reason="OpenCV finds the ORB features")
    folder = tmp_path_factory.mktemp("town") / "town"
    flight = {"frames": 4, "image_width": 160, "image_height": 120, "samples": 1}
    make_sample(folder, SampleSettings().replace({f"flight.{name}": value for name, value in flight.items()}))
    return pictures_below(folder / "images")


@pytest.fixture(scope="module")
def trained(pictures: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("words") / "words.txt"
    train_vocabulary(pictures, path, SMALL)
    return path


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().split("\n")]


def test_a_trained_vocabulary_is_sound_and_full(pictures: list[Path], tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    report = train_vocabulary(pictures, tmp_path / "w.txt", SMALL, progress=events.append)
    shape = check_vocabulary(tmp_path / "w.txt")
    assert (shape.branches, shape.levels) == (4, 5)
    assert (shape.nodes, shape.words) == (report.nodes, report.words)
    assert report.to_dict()["pictures"] == 4
    # Each word holds a descriptor at least; far fewer words than half of them would be a tree that does not split.
    assert report.descriptors / 4 < report.words <= report.descriptors
    last = [event for event in events if event.stage == "vocabulary.tree"][-1]
    assert last.done == last.total == report.descriptors


def test_the_same_seed_gives_the_same_file_and_another_one_another(pictures: list[Path], tmp_path: Path) -> None:
    made = []
    for number, seed in enumerate((3, 3, 4)):
        train_vocabulary(pictures, tmp_path / f"{number}.txt", SMALL, seed=seed)
        made.append((tmp_path / f"{number}.txt").read_bytes())
    assert made[0] == made[1] != made[2]


def test_words_that_few_pictures_show_weigh_more_and_none_weighs_nothing(trained: Path) -> None:
    weights = {round(float(row[-1]), 6) for row in rows(trained)[1:] if row[1] == "1"}
    # A word is seen in 1 to 4 of 4 pictures.
    assert weights <= {round(float(np.log(5 / n)), 6) for n in (1, 2, 3, 4)}
    assert min(weights) > 0
    assert len(weights) > 1


def test_a_child_is_nearer_to_its_descriptors_than_its_siblings(trained: Path) -> None:
    """Words of different parents at the first level are farther apart than words of the same (k-majority works)."""
    nodes = rows(trained)[1:]
    parents = np.array([0, *(int(row[0]) for row in nodes)])
    bits = np.unpackbits(np.array([row[2:34] for row in nodes], dtype=np.uint8), axis=1).astype(int)
    top = np.arange(len(parents))
    while (parents[top] != 0).any():
        top = parents[top]
    words = np.array([i for i, row in enumerate(nodes) if row[1] == "1"])[::3]
    distance = np.abs(bits[words][:, None] - bits[words][None]).sum(axis=2)
    same = top[words + 1][:, None] == top[words + 1][None]
    other = ~np.eye(len(words), dtype=bool)
    assert distance[same & other].mean() < distance[~same].mean() - 10


def test_pictures_without_features_and_no_pictures_are_told(tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="OpenCV finds the ORB features")
    Image.new("RGB", (64, 64), "grey").save(tmp_path / "grey.png")
    with pytest.raises(DataError, match=r"too few features.*at least 500.*found 0 in 1 pictures"):
        train_vocabulary([tmp_path / "grey.png"], tmp_path / "w.txt", SMALL)
    with pytest.raises(DataError, match="needs pictures"):
        train_vocabulary([], tmp_path / "w.txt", SMALL)
    assert not (tmp_path / "w.txt").exists()


def test_training_can_be_cancelled_and_leaves_nothing(pictures: list[Path], tmp_path: Path) -> None:
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        train_vocabulary(pictures, tmp_path / "w.txt", SMALL, progress=token)
    assert not list(tmp_path.iterdir())


def test_without_opencv_the_cure_is_named(
    pictures: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingDependencyError, match="'cv2' cannot be imported.*pip install"):
        train_vocabulary(pictures, tmp_path / "w.txt", SMALL)


def test_the_command_trains_and_says_what_it_made(
    pictures: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "w.txt"
    code = main(["vocabulary", str(pictures[0].parent), str(out), "--features", "300", "--levels", "5"])
    assert code == 0
    assert "features of 4 pictures" in capsys.readouterr().out
    assert check_vocabulary(out).levels == 5


def edit(line: int, place: int, text: str) -> Callable[[list[list[str]]], None]:
    def change(lines: list[list[str]]) -> None:
        lines[line - 1][place] = text

    return change


def cut(line: int) -> Callable[[list[list[str]]], None]:
    def change(lines: list[list[str]]) -> None:
        del lines[line - 1][20:]

    return change


def childless(lines: list[list[str]]) -> None:
    next(row for row in reversed(lines) if row[1] == "1")[1] = "0"


def only_the_header(lines: list[list[str]]) -> None:
    del lines[1:]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edit(1, 1, "4"), r"line 1 .*5 to 10 levels"),
        (edit(1, 0, "100"), r"line 1 .*2 to 20 branches"),
        (edit(1, 2, "9"), r"line 1 .*scoring 0 to 5"),
        (edit(3, 0, "99999"), r"line 3 .*a parent that came before"),
        (edit(3, 0, "2"), r"line 3 .*a parent that came before"),
        (edit(3, 0, "-1"), r"line 3 .*a parent that came before"),
        (edit(4, 1, "2"), r"line 4 .*0 or 1 in the second place"),
        (edit(2, 1, "1"), r"line 2 .*no children of a word"),
        (edit(5, 9, "256"), r"line 5 .*32 bytes of 0 to 255"),
        (edit(5, 9, "1.5"), r"line 5 .*'parent is_leaf"),
        (edit(6, 34, "nan"), r"line 6 .*a finite weight"),
        (edit(6, 34, "-1"), r"line 6 .*a finite weight"),
        (edit(1, 0, "2"), r"at most the 2 children"),
        (cut(7), r"line 7 .*'parent is_leaf"),
        (childless, r"children of a node that is no word"),
        (only_the_header, r"a tree of at least two words"),
    ],
)
def test_a_damaged_vocabulary_is_refused_by_its_line(
    trained: Path, tmp_path: Path, change: Callable[[list[list[str]]], None], message: str
) -> None:
    lines = rows(trained)
    change(lines)
    path = tmp_path / "w.txt"
    path.write_text("\n".join(" ".join(line) for line in lines))
    with pytest.raises(DataError, match=message):
        check_vocabulary(path)


def test_a_missing_vocabulary_and_one_that_is_no_text_are_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"is missing\. Train one: toolkit vocabulary"):
        check_vocabulary(tmp_path / "w.txt")
    (tmp_path / "w.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="Cannot read the vocabulary"):
        check_vocabulary(tmp_path / "w.txt")


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a vocabulary of two branches, written by hand as DBoW2 would."""
    rng = np.random.default_rng(0)
    lines = ["2 5 0 0"]
    for node in range(1, 63):
        described = " ".join(map(str, rng.integers(0, 256, 32)))
        lines.append(f"{(node - 1) // 2} {int(node > 30)} {described} {0.5 if node > 30 else 0}")
    path = tmp_path_factory.mktemp("full") / "full.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_vocabulary_of_dbow2_is_taken(full: Path) -> None:
    shape = check_vocabulary(full)
    assert (shape.branches, shape.levels, shape.nodes, shape.words) == (2, 5, 62, 32)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_is_done_to_a_file_it_is_sound_or_refused(full: Path, tmp_path: Path, data: st.DataObject) -> None:
    """A file that passes is one that DBoW2's reader takes without touching memory that is not its own."""
    content = bytearray(full.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 2))] = data.draw(
            st.sampled_from([b"", b" ", b"\n", b"9", b"-", b"."])
        )
    path = tmp_path / "w.txt"
    path.write_bytes(content)
    try:
        shape = check_vocabulary(path)
    except DataError:
        return
    lines = rows(path)[1:]
    if lines[-1] == []:
        lines.pop()
    assert shape.nodes == len(lines)
    for number, row in enumerate(lines, start=1):
        assert len(row) == 35
        assert 0 <= int(row[0]) < number
        assert all(0 <= int(word) <= 255 for word in row[2:34])


def test_training_needs_nothing_that_numpy_1_lacks(
    pictures: list[Path], trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(np, "bitwise_count", raising=False)
    train_vocabulary(pictures, tmp_path / "again.txt", SMALL)
    assert (tmp_path / "again.txt").read_bytes() == trained.read_bytes()


def test_differing_bits_are_counted_in_bytes_and_in_words() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (7, 32), dtype=np.uint8) for _ in range(2))
    b[0] = ~a[0]
    expected = np.unpackbits(a ^ b, axis=1).sum(axis=1)
    assert expected[0] == 256
    np.testing.assert_array_equal(hamming(a, b), expected)
    np.testing.assert_array_equal(hamming(a.view(np.uint64), b.view(np.uint64)), expected)
    np.testing.assert_array_equal(hamming(a[:, None], b[None])[3], np.unpackbits(a[3] ^ b, axis=1).sum(axis=1))
