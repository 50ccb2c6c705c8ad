"""Fixtures that all rooms share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A busy machine is no failure: no deadline for a single example.
settings.register_profile("toolkit", deadline=None)
settings.load_profile("toolkit")


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
