"""Slips in the CUDA kernels are noticed: each removed barrier by name, and wrong indices one way or another."""

from __future__ import annotations

import pytest
import torch

from perception.rasterizer import device
from perception.rasterizer.cuda import training
from support.cuda_emulator import emulate, emulated
from support.cuda_mutants import BARRIERS, SLIPS, TRAINING_BARRIERS, is_noticed, mutant_scene

QUICK = BARRIERS[5], TRAINING_BARRIERS[0]  # the first is of one warp, which no order of the lanes shows
MISSING = r"without a barrier between|that no thread of the block wrote"


def empty(*shape):
    return torch.empty(*shape, dtype=torch.float64)


def run_training_kernels():
    """Loss and prototypes of an image."""
    image = torch.rand(20, 30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    training.photometric(image, image.flip(0).contiguous(), None, torch.empty_like(image), 0.2)
    features, slots = image.view(-1, 18), torch.zeros(100, dtype=torch.int32)
    training.prototypes(features, slots, torch.tensor([100]), torch.tensor([0]), empty(1, 18), empty(1))


def test_missing_barriers_of_both_kinds_are_noticed(monkeypatch):
    """In one build, without features as training has it: each barrier is of another kernel."""
    with pytest.raises(RuntimeError, match=MISSING):
        emulate(mutant_scene(dims=0), edits=QUICK, depth=False)
    monkeypatch.setattr(device, "device_kernels", emulated(edits=QUICK))
    with pytest.raises(RuntimeError, match=MISSING):
        run_training_kernels()


@pytest.mark.slow
@pytest.mark.parametrize("edit", BARRIERS)
def test_a_missing_barrier_is_noticed_in_the_order_of_the_lanes(edit):
    with pytest.raises(RuntimeError, match=MISSING):
        emulate(mutant_scene(), edits=(edit,))


@pytest.mark.slow
@pytest.mark.parametrize("edit", TRAINING_BARRIERS)
def test_a_missing_barrier_of_training_is_noticed(edit, monkeypatch):
    monkeypatch.setattr(device, "device_kernels", emulated(edits=(edit,)))
    with pytest.raises(RuntimeError, match=MISSING):
        run_training_kernels()


@pytest.mark.slow
def test_nothing_is_noticed_in_the_kernels_as_they_are():
    assert not is_noticed()


@pytest.mark.slow
@pytest.mark.parametrize("edit", SLIPS, ids=[replaced for _, replaced in SLIPS])
def test_a_slip_is_noticed(edit):
    assert is_noticed(edit)
