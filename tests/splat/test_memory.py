"""How many Gaussians fit: what the system says, what training takes, and what follows."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import StageError
from toolkit.splat.memory import SHARE, bytes_per_gaussian, free_memory, most_gaussians
from toolkit.splat.train_settings import TrainSettings


def test_free_memory_is_what_linux_calls_available(tmp_path: Path) -> None:
    table = tmp_path / "meminfo"
    table.write_text("MemTotal:       24000000 kB\nMemFree:         1000000 kB\nMemAvailable:    9000000 kB\n")
    assert free_memory(table) == 9_000_000 * 1024
    table.write_text("MemTotal:       24000000 kB\n")
    assert free_memory(table) is None
    assert free_memory(tmp_path / "nowhere") is None


def test_higher_degrees_take_more() -> None:
    sizes = [bytes_per_gaussian(degree) for degree in range(4)]
    assert sizes == sorted(set(sizes))
    # Four times 59 numbers of four bytes are held at every moment.
    assert sizes[3] > 4 * 59 * 4


def test_the_cap_is_the_settings_or_what_fits() -> None:
    settings = TrainSettings(max_gaussians=1000)
    room = 1000 * bytes_per_gaussian(3) / SHARE
    assert most_gaussians(settings, 10, None) == 1000
    assert most_gaussians(settings, 10, int(2 * room)) == 1000
    assert most_gaussians(settings, 10, int(0.5 * room) + 10) == 500


def test_the_first_gaussians_must_fit() -> None:
    room = int(500 * bytes_per_gaussian(3) / SHARE) + 10
    assert most_gaussians(TrainSettings(max_gaussians=400), 10_000, room) == 400
    with pytest.raises(StageError, match=r"does not hold the first.*for 10000 Gaussians.*lower max_gaussians"):
        most_gaussians(TrainSettings(), 10_000, room)
