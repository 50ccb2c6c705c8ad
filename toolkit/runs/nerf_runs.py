"""Runs of the tables of radiance fields: segments cut from one film, and weights handed from row to row."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from toolkit.errors import DataError
from toolkit.progress import Progress, silent
from toolkit.recipes.base import Recipe
from toolkit.runs.nerf_table import ROWS, NerfRow
from toolkit.runs.paper_runs import Attempt, TableOptions, make_attempts
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import write_scene

#: Fewer pictures leave none to test on, or too few to learn from.
LEAST_PICTURES = 3
#: As in captures that name no test pictures.
TEST_EVERY = 8


def make_nerf_attempts(
    rows: Sequence[NerfRow],
    films: Mapping[str, Path],
    recipes: Mapping[str, Recipe],
    options: TableOptions,
    *,
    stride: int,
    segments: Path,
    progress: Progress = silent,
) -> list[Attempt]:
    """Run every row on its segment of every film, and return how each ended, in the order of the rows.

    A row that starts from another's weights has that one run first, whether it is among the rows or not.

    Parameters
    ----------
    films:
        Folders with poses that :func:`toolkit.scene.dataset.open_capture` reads, by their names in the table.
    recipes, options:
        As :func:`~toolkit.runs.paper_runs.make_attempts` has them.
    stride:
        Every how many frames of a segment one is taken.
    segments:
        Folder for the segments: they refer to the films' pictures.

    Raises
    ------
    Cancelled
        Where ``progress`` says so.
    DataError
        Where a film cannot be opened or has no poses.
    """
    attempts = []
    for name, folder in films.items():
        film = _film(folder, progress)
        made = _Maker(name, film, recipes, options, stride, segments, progress)
        attempts += [made.attempt(row) for row in rows]
    return attempts


def segment(film: Scene, frames: int, stride: int) -> Scene:
    """Return the first ``frames`` of a film with poses, every ``stride``-th of them, without points.

    Every eighth picture that is left is a test picture. Points are left out, because those of the whole film tell
    more than the segment shows: whoever needs some triangulates them from the segment's pictures.
    """
    return film.replace(frames=film.frames[:frames:stride], points=None).with_every_nth_as_test(TEST_EVERY)


def _film(folder: Path, progress: Progress) -> Scene:
    reference = open_capture(folder, progress=progress).reference
    if reference is None:
        raise DataError(
            f"{folder} has no poses",
            expected="a film with true or surveyed poses, or a model in its folder",
            found="pictures alone",
            todo="Find poses first, or take the engine: toolkit sample engine",
        )
    return reference


@dataclasses.dataclass(slots=True)
class _Maker:
    """Makes the attempts on one film, each of them once."""

    name: str
    film: Scene
    recipes: Mapping[str, Recipe]
    options: TableOptions
    stride: int
    segments: Path
    progress: Progress
    made: dict[str, Attempt] = dataclasses.field(default_factory=dict)

    def attempt(self, row: NerfRow) -> Attempt:
        """Return how a row ended."""
        if row.key not in self.made:
            self.made[row.key] = self._attempt(row)
        return self.made[row.key]

    def _attempt(self, row: NerfRow) -> Attempt:
        if len(self.film) < row.frames:
            return Attempt(row.row, self.name, "not applicable", f"the film has {len(self.film)} frames")
        cut = segment(self.film, row.frames, self.stride)
        if len(cut) < LEAST_PICTURES:
            return Attempt(
                row.row, self.name, "not applicable", f"a stride of {self.stride} leaves {len(cut)} frames"
            )
        method = row.row
        if row.warm_from:
            first = self.attempt(next(each for each in ROWS if each.key == row.warm_from))
            if first.outcome != "finished" or first.run is None:
                return Attempt(
                    row.row, self.name, "not applicable", f"no weights, for {row.warm_from} {first.text}"
                )
            changes = {**method.changes, "train.warm_start": str(first.run.path.resolve())}
            method = dataclasses.replace(method, changes=changes)
        folder = self.segments / f"{self.name}-{row.frames}-every-{self.stride}"
        write_scene(cut, folder)
        ended = make_attempts([method], {self.name: folder}, self.recipes, self.options, progress=self.progress)[0]
        return dataclasses.replace(ended, row=row.row)
