"""Splats are read, packed and drawn in another process, whose end is told and does no harm."""

from __future__ import annotations

import io
import os
import time
from collections.abc import Iterator
from typing import NoReturn

import numpy as np
import pytest
from fake_recipe import MakeRun
from PIL import Image
from splat_recipe import SPLAT_RECIPE, coloured_balls

from toolkit.errors import RunError
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.view_render import ViewPose, packed_splat, render_view
from toolkit.runs.view_scene import ViewScene, read_view
from toolkit.runs.view_work import ViewProcess, ViewWork, shared_process
from toolkit.splat.ply import write_splats


@pytest.fixture
def run(queued: MakeRun) -> RunFolder:
    made = queued(name="balls")
    execute(made, recipe=SPLAT_RECIPE)
    return made


@pytest.fixture(scope="module")
def process() -> Iterator[ViewProcess]:
    made = ViewProcess()
    yield made
    made.close()


def pose_of(view: ViewScene) -> ViewPose:
    camera = view.cameras[0]
    return ViewPose(camera.position, camera.rotation, camera.focal, camera.principal, camera.size).scaled(6)


def end_at_once() -> NoReturn:
    os._exit(9)


def test_another_process_does_what_this_one_would(run: RunFolder, process: ViewProcess) -> None:
    here = read_view(run)
    view = process.open(run)
    assert view.cameras[3].to_dict() == here.scene.cameras[3].to_dict()
    assert (view.run, view.stamp, view.count) == (here.scene.run, here.scene.stamp, 300)
    assert process.pack(view) == packed_splat(here) == ViewWork().pack(view)
    drawn = np.asarray(Image.open(io.BytesIO(process.draw(view, pose_of(view)))))
    # JPEG of quality 88.
    assert np.abs(drawn.astype(int) - render_view(here, pose_of(view))).mean() < 2
    assert process._call(os.getpid) != os.getpid()


def test_errors_come_back_as_they_are(finished: MakeRun, process: ViewProcess) -> None:
    bare = finished()
    with pytest.raises(
        RunError, match=f"^Run {bare.id} has no splat; expected a finished run of a method .*run\\.$"
    ):
        process.open(bare)


def test_a_splat_that_was_written_again_is_not_taken_for_the_old_one(run: RunFolder) -> None:
    work = ViewWork()
    view = work.open(run)
    write_splats(coloured_balls(count=20), run.splat_file)
    assert len(work.pack(view)) > 1000  # kept since it was opened
    for seed in range(2):
        write_splats(coloured_balls(count=21 + seed), run.splat_file)
        work.open(run)
    with pytest.raises(RunError, match=f"The splat of run {run.id} was written again. Open the run again"):
        work.pack(view)


def test_the_end_of_the_process_is_told_and_the_next_call_begins_another(process: ViewProcess) -> None:
    with pytest.raises(
        RunError,
        match="The process that draws splats has ended; found no reason: a splat that is too large .*Try again",
    ):
        process._call(end_at_once)
    assert process._call(os.getpid) != os.getpid()


def test_a_process_without_work_ends() -> None:
    process = ViewProcess(idle=0.2)
    process._call(os.getpid)
    until = time.monotonic() + 20
    while process._workers is not None and time.monotonic() < until:
        time.sleep(0.1)
    assert process._workers is None
    assert process._call(os.getpid) != os.getpid()
    process.close()
    process.close()


def test_all_pages_of_a_server_share_one() -> None:
    assert shared_process() is shared_process()
