from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rpg.errors import CheckpointError, RPGError
from rpg.training.checkpoint import load_checkpoint, save_checkpoint

CONTENT = {
    "weights": {"w": torch.arange(6.0).view(2, 3)},
    "steps": 12,
    "episodes": [(1.5, 3, True)],
    "none": None,
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "checkpoint.pt"


def refusal(path: Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_content_comes_back_equal(path: Path) -> None:
    save_checkpoint(path, CONTENT)
    loaded = load_checkpoint(path)
    assert torch.equal(loaded["weights"]["w"], CONTENT["weights"]["w"])
    assert {k: loaded[k] for k in ("steps", "episodes", "none")} == {
        "steps": 12,
        "episodes": [(1.5, 3, True)],
        "none": None,
    }


def test_saving_again_replaces_and_leaves_nothing_else_behind(path: Path) -> None:
    save_checkpoint(path, CONTENT)
    save_checkpoint(path, {"steps": 13})
    assert load_checkpoint(path)["steps"] == 13
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize(
    "error",
    [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), RuntimeError("unexpected pos 64 vs 0\nwhile writing")],
    ids=["disk full", "torch's own"],
)
def test_a_failing_write_keeps_the_earlier_checkpoint(
    path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    save_checkpoint(path, CONTENT)

    def fail(content: Any, file: Any) -> None:
        file.write(b"half of it")
        raise error

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(RPGError, match="previous checkpoint is intact") as caught:
        save_checkpoint(path, {"steps": 13})
    assert "\n" not in str(caught.value)
    assert os.listdir(path.parent) == [path.name]
    assert load_checkpoint(path)["steps"] == 12


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full here")
def test_a_full_disk_is_reported_in_one_line(path: Path) -> None:
    save_checkpoint(path, CONTENT)
    path.with_suffix(".tmp").symlink_to("/dev/full")
    with pytest.raises(RPGError, match="No space left") as caught:
        save_checkpoint(path, {"steps": 13, "big": torch.zeros(10_000)})
    assert "\n" not in str(caught.value)
    assert load_checkpoint(path)["steps"] == 12


@pytest.mark.parametrize("folder", ["missing", "file"])
def test_a_folder_that_cannot_be_written_is_reported_in_one_line(tmp_path: Path, folder: str) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(RPGError, match="cannot be written") as caught:
        save_checkpoint(tmp_path / folder / "checkpoint.pt", CONTENT)
    assert "\n" not in str(caught.value)


class Malicious:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.target),))


@pytest.mark.parametrize(
    "write", [torch.save, lambda x, p: p.write_bytes(pickle.dumps(x))], ids=["torch", "pickle"]
)
def test_code_in_a_checkpoint_is_refused_and_not_run(path: Path, write: Any) -> None:
    victim = path.parent / "victim"
    write({"format": "rpg-checkpoint", "version": 1, "agent": Malicious(victim)}, path)
    refusal(path)
    assert not victim.exists()
    torch.load(path, weights_only=False) if write is torch.save else pickle.loads(path.read_bytes())
    assert victim.exists()  # the trap was real


def test_missing_file_is_named() -> None:
    assert "no such file" in refusal(Path("/nonexistent/checkpoint.pt"))


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused(path: Path, keep: float) -> None:
    save_checkpoint(path, CONTENT)
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(len(data) * keep)])
    assert "damaged" in refusal(path)


def test_noise_and_text_are_refused(path: Path) -> None:
    rng = np.random.default_rng(0)
    samples = [rng.bytes(200) for _ in range(200)]
    samples += [
        b"hello\n",
        b"{}",
        b"\x80\x02}q\x00.",
        b"\x80\x04N.",
        pickle.dumps([1, 2, 3]),
        b"PK\x03\x04" + bytes(60),
    ]
    for data in samples:
        path.write_bytes(data)
        refusal(path)


def test_flipped_bytes_are_refused_or_harmless(path: Path) -> None:
    save_checkpoint(path, CONTENT)
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(100):
        bad = bytearray(good)
        for at in rng.integers(len(good), size=8):
            bad[at] = rng.integers(256)
        path.write_bytes(bytes(bad))
        try:
            load_checkpoint(path)
        except CheckpointError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("content", [{"model": torch.zeros(2)}, torch.zeros(3), [1, 2], {"format": "else"}])
def test_files_of_other_programs_are_refused(path: Path, content: Any) -> None:
    torch.save(content, path)
    assert "not written by rpg" in refusal(path)


def test_another_version_is_refused_by_number(path: Path) -> None:
    torch.save({"format": "rpg-checkpoint", "version": 99}, path)
    assert "version 99" in refusal(path)


def test_a_folder_in_its_place_is_refused(path: Path) -> None:
    path.mkdir()
    refusal(path)
