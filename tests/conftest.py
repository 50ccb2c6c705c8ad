"""Fixtures that all rooms share."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# A busy machine is no failure: no deadline for a single example.
settings.register_profile("toolkit", deadline=None)
settings.load_profile("toolkit")


#: Bytes that must be free where tests put their files.
ROOM = 2 * 10**9


def pytest_sessionstart(session: pytest.Session) -> None:
    """End at once where the disk is nearly full: hundreds of failures would hide the one reason."""
    folder = tempfile.gettempdir()
    free = shutil.disk_usage(folder).free
    if free < ROOM:
        pytest.exit(f"The tests need {ROOM / 1e9:g} GB in {folder}, and {free / 1e9:.1f} GB are free", returncode=3)


@pytest.fixture
def real_data() -> Path:
    """Return the folder of real pictures, or skip where ``TOOLKIT_DATA`` does not name it."""
    named = os.environ.get("TOOLKIT_DATA")
    if not named:
        pytest.skip("TOOLKIT_DATA is not set: it names the folder with the real pictures")
    folder = Path(named)
    if not folder.is_dir():
        pytest.fail(f"TOOLKIT_DATA names {folder}, which is no folder")
    return folder
