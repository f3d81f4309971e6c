"""Slips in the CUDA kernels are noticed: each removed barrier by name, and wrong indices one way or another."""

from __future__ import annotations

import pytest

from support.cuda_emulator import emulate
from support.cuda_mutants import BARRIERS, SLIPS, is_noticed, mutant_scene

QUICK = 5  # a barrier of one warp, which no order of the lanes shows


@pytest.mark.parametrize(
    "edit", [pytest.param(e, marks=[pytest.mark.slow] * (i != QUICK)) for i, e in enumerate(BARRIERS)]
)
def test_a_missing_barrier_is_noticed_in_the_order_of_the_lanes(edit):
    with pytest.raises(RuntimeError, match=r"without a barrier between|that no thread of the block wrote"):
        emulate(mutant_scene(), edit=edit)


@pytest.mark.slow
def test_nothing_is_noticed_in_the_kernels_as_they_are():
    assert not is_noticed(None)


@pytest.mark.slow
@pytest.mark.parametrize("edit", SLIPS, ids=[replaced for _, replaced in SLIPS])
def test_a_slip_is_noticed(edit):
    assert is_noticed(edit)
