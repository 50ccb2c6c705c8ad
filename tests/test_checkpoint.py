"""Checkpoints: whole or absent, the last two kept, damage found and told."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from toolkit.checkpoint import Checkpoint, load_checkpoint, load_newest, require_same, save_checkpoint
from toolkit.errors import DataError, RunError


def checkpoint(step: int) -> Checkpoint:
    generator = torch.Generator().manual_seed(step)
    tensors = {
        "a": torch.rand(50, 3, generator=generator),
        "order": torch.randperm(9, generator=generator),
        "generator": generator.get_state(),
        "empty": torch.zeros(0, 3),
    }
    return Checkpoint(step, tensors, {"position": step, "loss": 0.1 + step / 3, "nothing": None})


def test_what_was_saved_comes_back_to_the_bit(tmp_path: Path) -> None:
    saved = checkpoint(7)
    back = load_checkpoint(save_checkpoint(tmp_path, saved))
    assert back.step == 7
    assert back.state == saved.state
    assert back.tensors.keys() == saved.tensors.keys()
    for name, tensor in saved.tensors.items():
        assert torch.equal(back.tensors[name], tensor)
        assert back.tensors[name].dtype == tensor.dtype


def test_the_last_two_are_kept_and_the_newest_is_found(tmp_path: Path) -> None:
    for step in (5, 10, 15):
        save_checkpoint(tmp_path, checkpoint(step))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "step-00000010.safetensors",
        "step-00000015.safetensors",
    ]
    newest, notes = load_newest(tmp_path)
    assert newest is not None
    assert newest.step == 15
    assert notes == ()


def test_an_empty_or_missing_folder_has_none(tmp_path: Path) -> None:
    assert load_newest(tmp_path) == (None, ())
    assert load_newest(tmp_path / "absent") == (None, ())


def test_what_a_killed_writer_left_is_not_read_and_goes_with_the_next(tmp_path: Path) -> None:
    half = tmp_path / ".step-00000005.0123abcd.tmp.safetensors"
    half.write_bytes(b"half")
    assert load_newest(tmp_path) == (None, ())
    save_checkpoint(tmp_path, checkpoint(10))
    assert [path.name for path in tmp_path.iterdir()] == ["step-00000010.safetensors"]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_a_truncated_file_is_told_and_the_one_before_is_used(tmp_path: Path, share: float) -> None:
    save_checkpoint(tmp_path, checkpoint(5))
    path = save_checkpoint(tmp_path, checkpoint(10))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(DataError, match=rf"{re.escape(str(path))} is damaged; expected a whole safetensors file"):
        load_checkpoint(path)
    older, notes = load_newest(tmp_path)
    assert older is not None
    assert older.step == 5
    assert len(notes) == 1
    assert "step-00000010.safetensors is damaged" in notes[0]


def test_a_changed_byte_is_noticed(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path, checkpoint(10))
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"is damaged; expected checksum [0-9a-f]{8}; found checksum"):
        load_checkpoint(path)


def test_where_all_are_damaged_nothing_is_started_silently(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, checkpoint(5)).write_bytes(b"")
    with pytest.raises(DataError, match=r"No checkpoint in .* can be read; .*Delete the folder to start from the"):
        load_newest(tmp_path)


def test_other_safetensors_files_are_not_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "step-00000001.safetensors"
    save_file({"a": torch.zeros(3)}, path)
    with pytest.raises(DataError, match="is no checkpoint of this version; .*found another safetensors file"):
        load_checkpoint(path)
    save_file({"a": torch.zeros(3)}, path, metadata={"checkpoint": '{"format": 99}'})
    with pytest.raises(DataError, match="expected format 1; found format 99"):
        load_checkpoint(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"step-00000001\.safetensors is missing"):
        load_checkpoint(tmp_path / "step-00000001.safetensors")


def test_a_folder_that_may_not_be_written_keeps_what_it_has(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, checkpoint(5))
    blocked = tmp_path / "step-00000010.safetensors"
    blocked.mkdir()  # stands in the way, also for root
    with pytest.raises((RunError, OSError)):
        save_checkpoint(tmp_path, checkpoint(10))
    assert load_checkpoint(tmp_path / "step-00000005.safetensors").step == 5
    assert not list(tmp_path.glob(".*"))


def test_a_run_with_other_settings_is_another_run(tmp_path: Path) -> None:
    before = {"settings": {"steps": 10, "cap": 5}, "seed": 0, "scene": {"points": "ab"}}
    require_same(before, {**before}, tmp_path)
    with pytest.raises(
        RunError, match=r"another run; expected settings\.cap = 6, seed = 1; found settings\.cap = 5"
    ):
        require_same(before, {**before, "settings": {"steps": 10, "cap": 6}, "seed": 1}, tmp_path)
    with pytest.raises(RunError, match=r"expected scene\.points = cd; found scene\.points = ab"):
        require_same(before, {**before, "scene": {"points": "cd"}}, tmp_path)
