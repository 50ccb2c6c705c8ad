"""Pairs of look-alike blades are found by the sequence: on points with matches made by hand, and on pictures."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from toolkit.errors import Cancelled, DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.database import create_database, match_counts
from toolkit.matching.descriptors import read_keypoints
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings, verify_pairs
from toolkit.matching.pair_rotations import apparent_rotation, chain_rotations
from toolkit.matching.pairs import ChosenPairs, PairSettings
from toolkit.matching.scene_matches import match_scene
from toolkit.matching.wrong_pairs import WrongPairs, WrongPairSettings, drop_pairs, find_wrong_pairs
from toolkit.progress import ProgressEvent, silent
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.scene import Frame, Scene

BLADES, POINTS, STEP = 12, 30, 5.0
PITCH = 360.0 / BLADES
#: Frames in which one blade takes the place of the next.
PERIOD = round(PITCH / STEP)
SETTINGS = WrongPairSettings(near=2)
CAMERA = ColmapCamera("PINHOLE", 480, 360, (230.0, 230.0, 240.0, 180.0), prior_focal_length=True)


def camera_at(angle: float) -> RigidTransform:
    """Return the pose before the ring at an angle in degrees; it looks onto the blades and a little ahead."""
    turn = math.radians(angle)
    place = (1.2 * math.cos(turn), 1.2 * math.sin(turn), 0.9)
    ahead = turn + math.radians(6.0)
    return RigidTransform.look_at(place, (math.cos(ahead), math.sin(ahead), 0.0), up=(*place[:2], 0.0))


def ring() -> np.ndarray:
    """Return points (B, P, 3): all blades carry the same ones."""
    rng = np.random.default_rng(5)
    radius, turn, height = (
        rng.uniform(0.7, 1.3, POINTS),
        rng.uniform(-12, 12, POINTS),
        rng.uniform(-0.2, 0.2, POINTS),
    )
    turns = np.radians(turn + PITCH * np.arange(BLADES)[:, None])
    shape = np.ones((BLADES, POINTS))
    return np.stack([radius * np.cos(turns), radius * np.sin(turns), height * shape], axis=-1)


class Film:
    """A camera that circles the ring, with keypoints and matches in a database."""

    def __init__(self, folder: Path, frames: int) -> None:
        self.angles = STEP * np.arange(frames)
        self.scene = Scene(folder, {1: CAMERA}, tuple(Frame(f"{i:03d}.png", 1) for i in range(frames)))
        self.path = folder / "matches.db"
        create_database(self.path, self.scene, {1: CAMERA})
        rng = np.random.default_rng(1)
        self.row: list[dict[tuple[int, int], int]] = []
        with closing(pycolmap.Database.open(self.path)) as database, pycolmap.DatabaseTransaction(database):
            for number, angle in enumerate(self.angles, start=1):
                points = camera_at(angle).apply(ring().reshape(-1, 3))
                pixels = CAMERA.project(points)
                inside = (points[:, 2] > 0.2) & np.all((pixels > 0) & (pixels < (480, 360)), axis=1)
                seen = np.flatnonzero(inside)
                database.write_keypoints(number, pixels[seen] + rng.normal(0, 0.3, (len(seen), 2)))
                self.row.append({divmod(int(point), POINTS): row for row, point in enumerate(seen)})

    def match(self, right: Iterable[tuple[int, int]], alike: Iterable[tuple[int, int]] = ()) -> None:
        """Write and verify matches of the same points of pairs, and of points that look alike in the two views."""
        pairs = dict.fromkeys(right, 0)
        # As many blades on as bring the second view nearest to the first.
        pairs |= {(i, j): round((self.angles[j] - self.angles[i]) / PITCH) for i, j in alike}
        with closing(pycolmap.Database.open(self.path)) as database, pycolmap.DatabaseTransaction(database):
            for (i, j), shift in sorted(pairs.items()):
                same = [
                    (row, self.row[j][key])
                    for (blade, point), row in self.row[i].items()
                    if (key := ((blade + shift) % BLADES, point)) in self.row[j]
                ]
                database.write_matches(i + 1, j + 1, np.array(same, dtype=np.uint32).reshape(-1, 2))
        chosen = ChosenPairs("by hand", len(self.scene), np.array(sorted(pairs)))
        verify_pairs(self.path, chosen, MatchSettings(), seed=0, progress=silent)

    def lag(self, *steps: int) -> list[tuple[int, int]]:
        """Return the pairs of frames that are so far apart."""
        count = len(self.scene)
        return [(i, i + step) for step in steps for i in range(count - step)]

    def judge(self, settings: WrongPairSettings = SETTINGS) -> WrongPairs:
        return find_wrong_pairs(self.path, self.scene, settings)


def as_set(pairs: np.ndarray) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in pairs}


def test_look_alikes_are_wrong_and_the_same_blade_is_right(tmp_path: Path) -> None:
    film = Film(tmp_path, 36)
    alike = film.lag(PERIOD - 1, PERIOD, PERIOD + 1, 2 * PERIOD, 4 * PERIOD)
    film.match(film.lag(1, 2, 3, 4), alike)
    found = film.judge()
    assert found.inliers.min() >= 15
    assert as_set(found.wrong) == set(alike)
    assert as_set(found.of("near")) == set(film.lag(1, 2))
    assert as_set(found.of("right")) == set(film.lag(3, 4))
    summary = found.to_dict()
    assert summary["wrong"] == len(alike) == len(summary["wrong_pairs"])
    assert summary["pairs"] == len(found.pairs) == summary["near"] + summary["right"] + summary["wrong"]
    # 0.3 pixels of 230, in some 60 points: hundredths of a degree.
    assert 0 < summary["sigma_deg"] < 0.3
    # A pair a whole pitch apart claims that nothing turned; the chain saw the view turn.
    row = found.pairs.tolist().index([3, 3 + PERIOD])
    assert found.claimed_deg[row] < 1
    assert found.chained_deg[row] == pytest.approx(found.difference_deg[row], rel=0.1)
    assert found.tracks.agreeing[row] == 0


def test_the_same_distance_can_be_right_or_wrong(tmp_path: Path) -> None:
    film = Film(tmp_path, 24)
    apart = film.lag(PERIOD)
    film.match([*film.lag(1, 2, 3), *apart[::2]], apart[1::2])
    found = film.judge()
    assert as_set(found.wrong) == set(apart[1::2])
    assert set(apart[::2]) <= as_set(found.of("right"))


def test_without_look_alikes_nothing_is_wrong(tmp_path: Path) -> None:
    film = Film(tmp_path, 20)
    film.match(film.lag(*range(1, 9)))
    assert not len(film.judge().wrong)


def test_around_a_closed_turn_the_shorter_way_counts(tmp_path: Path) -> None:
    film = Film(tmp_path, round(360 / STEP))
    count = len(film.scene)
    across = [(i, j) for i in range(5) for j in range(count - 5, count) if i + count - j <= 5]
    alike = [*film.lag(PERIOD, 5 * PERIOD), *((i, i + count - PERIOD) for i in range(PERIOD))]
    film.match([*film.lag(1, 2, 3, 4), *across], alike)
    closed = film.judge(WrongPairSettings(near=2, closed=True))
    assert as_set(closed.wrong) == set(alike)
    assert set(across) <= as_set(closed.of("near")) | as_set(closed.of("right"))
    # Who does not know that the film closes must take the seam for look-alikes.
    assert set(across) <= as_set(film.judge().wrong)


def test_ends_that_come_back_judge_each_other(tmp_path: Path) -> None:
    # 370 degrees: the last frames show what the first ones showed, and it is not said which. Some are a blade off.
    turn = round(360 / STEP)
    film = Film(tmp_path, turn + 3)
    seam = [(i, j) for i in range(6) for j in range(turn - 3, turn + 3)]
    same = [(i, j) for i, j in seam if abs(j - turn - i) <= 3]
    off = [(i, j) for i, j in seam if abs(j - turn - i + PERIOD) <= 1]
    assert len(same) > 2 * len(off) > 10
    film.match([*film.lag(1, 2, 3), *same], off)
    found = film.judge(WrongPairSettings(near=2, ends=6))
    assert set(same) <= as_set(found.of("right"))
    assert as_set(found.wrong) == set(off)
    # Without being told, the chain must take all of them for look-alikes.
    assert {*same, *off} <= as_set(film.judge().wrong)


def test_ends_that_contradict_each_other_stay_uncertain(tmp_path: Path) -> None:
    turn = round(360 / STEP)
    film = Film(tmp_path, turn + 3)
    same, off = [(0, turn), (1, turn + 1)], [(5, turn - 1), (4, turn - 2), (3, turn - 3)]
    film.match([*film.lag(1, 2), *same], off)
    found = film.judge(WrongPairSettings(near=2, ends=6))
    assert as_set(found.of("uncertain")) == {*same, *off}


def test_dropped_pairs_are_gone_from_the_copy_alone(tmp_path: Path) -> None:
    film = Film(tmp_path, 16)
    film.match(film.lag(1, 2, 3), film.lag(PERIOD))
    wrong = film.judge().wrong
    before = match_counts(film.path)[0]
    assert drop_pairs(film.path, np.concatenate([wrong, [[0, 15]]]), tmp_path / "clean.db") == len(wrong) == 10
    assert len(match_counts(film.path)[0]) == len(before)
    left, _, inliers = match_counts(tmp_path / "clean.db")
    assert as_set(left) == as_set(before) - as_set(wrong)
    assert (inliers > 0).all()
    with closing(sqlite3.connect(tmp_path / "clean.db")) as connection:
        (rows,) = connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()
    assert rows == len(left)
    # What is left is judged as sound.
    assert not len(find_wrong_pairs(tmp_path / "clean.db", film.scene, SETTINGS).wrong)


def test_a_database_is_not_dropped_into_itself(tmp_path: Path) -> None:
    film = Film(tmp_path, 4)
    with pytest.raises(DataError, match="is the database itself"):
        drop_pairs(film.path, [[0, 1]], film.path)
    with pytest.raises(DataError, match=r"none\.db is missing"):
        drop_pairs(tmp_path / "none.db", [[0, 1]], tmp_path / "other.db")


def test_without_near_pairs_it_says_so(tmp_path: Path) -> None:
    film = Film(tmp_path, 16)
    film.match(film.lag(4), film.lag(PERIOD))
    with pytest.raises(StageError, match="Too few near pairs.*found 0 frames in the longest chain"):
        film.judge()


def test_a_chain_of_less_than_half_of_the_frames_is_too_short(tmp_path: Path) -> None:
    film = Film(tmp_path, 20)
    film.match([(i, j) for i, j in film.lag(1, 2) if j < 9], film.lag(PERIOD))
    with pytest.raises(StageError, match="at least half of the 20 frames.*found 9 frames"):
        film.judge()


def test_pairs_across_a_gap_stay_uncertain(tmp_path: Path) -> None:
    film = Film(tmp_path, 24)
    film.match([(i, j) for i, j in film.lag(1, 2) if j < 18 or i >= 18], film.lag(PERIOD))
    found = film.judge()
    assert as_set(found.wrong) == {(i, i + PERIOD) for i in range(18 - PERIOD)}
    assert as_set(found.of("uncertain")) == {(i, i + PERIOD) for i in range(18 - PERIOD, 18)}
    row = found.pairs.tolist().index([14, 14 + PERIOD])
    assert math.isnan(found.chained_deg[row])


def test_a_database_of_another_scene_is_refused(tmp_path: Path) -> None:
    film = Film(tmp_path, 6)
    with pytest.raises(DataError, match="does not belong to this scene"):
        find_wrong_pairs(film.path, film.scene.replace(frames=film.scene.frames[:5]), SETTINGS)


def test_judging_tells_how_far_it_is_and_can_be_cancelled(tmp_path: Path) -> None:
    film = Film(tmp_path, 10)
    film.match(film.lag(1, 2))
    events: list[ProgressEvent] = []
    find_wrong_pairs(film.path, film.scene, SETTINGS, progress=events.append)
    assert [event.done for event in events if event.stage == "pairs.rotations"] == list(range(18))

    def stop(event: ProgressEvent) -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        find_wrong_pairs(film.path, film.scene, SETTINGS, progress=stop)


def test_a_rotation_is_found_in_spite_of_a_third_of_wrong_rays() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    rays = rng.normal(size=(90, 3)) + np.array([0.0, 0.0, 4.0])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned = Rotation.from_rotvec([0.02, -0.05, 0.3]).as_matrix()
    seen = rays @ turned.T
    seen[:30] = seen[rng.permutation(30)]
    found = apparent_rotation(rays, seen)
    # Weights are bounded at 1e-4 rad, so outliers leave that much.
    np.testing.assert_allclose(found, turned, atol=2e-3)
    assert np.linalg.det(found) == pytest.approx(1)


def test_the_chain_averages_what_near_pairs_say() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(2)
    truth = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.2, (30, 3)), axis=0)).as_matrix()
    pairs = np.array([(i, j) for i in range(30) for j in range(i + 1, min(i + 4, 30)) if 12 not in (i, j)])
    noise = Rotation.from_rotvec(rng.normal(0, 0.01, (len(pairs), 3))).as_matrix()
    turned = noise @ truth[pairs[:, 1]] @ np.swapaxes(truth[pairs[:, 0]], 1, 2)
    turned[5] = np.eye(3)
    chain = chain_rotations(30, pairs, turned)
    assert np.isnan(chain[12]).all()
    known = np.delete(np.arange(30), 12)
    found = chain[known] @ np.swapaxes(chain[[0]], 1, 2)
    wanted = truth[known] @ np.swapaxes(truth[[0]], 1, 2)
    error = Rotation.from_matrix(np.swapaxes(found, 1, 2) @ wanted).magnitude()
    # 30 steps of 0.01 rad each make 0.05; three pairs a frame make it less, one wrong pair not more.
    assert error.max() < 0.06


def test_on_rendered_blades_sift_is_fooled_and_the_sequence_is_not(tmp_path: Path) -> None:
    small = {
        "film.frames": 18,
        "film.stride": 5,
        "film.samples": 1,
        "borescope.image_width": 320,
        "borescope.image_height": 240,
        "borescope.casing": 0.0,
        "borescope.icon": False,
        "points": 0,
    }
    engine = make_engine(tmp_path / "engine", EngineSettings().replace(small))
    scene, path = engine.scene.without_poses(), tmp_path / "matches.db"
    match_scene(scene, path, SiftSettings(max_features=1500), PairSettings())
    found = find_wrong_pairs(path, scene, WrongPairSettings(near=engine.window))
    pixels, share = read_keypoints(path), []
    with closing(pycolmap.Database.open(path)) as database:
        for i, j in found.pairs.tolist():
            first, second = database.read_two_view_geometry(i + 1, j + 1).inlier_matches.T
            share.append(engine.right_matches(i, j, pixels[i + 1][first], pixels[j + 1][second]).mean())
    right = np.array(share)
    is_wrong = (found.pairs[:, None] == found.wrong[None]).all(axis=2).any(axis=1)
    assert np.sum(right <= 0.2) > 60
    assert np.mean(is_wrong[right <= 0.2]) >= 0.95
    # Half of the matches right: what is dropped of these is lost. One in twenty is let.
    assert np.mean(is_wrong[right >= 0.5]) <= 0.05
