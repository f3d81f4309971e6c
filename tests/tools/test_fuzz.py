"""Every fuzz target on a fixed, short set of mutated inputs; tools/fuzz/run.py does the same without an end."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzz.core import SHELL, CoreTarget, guarded, intact
from fuzz.run import LONGEST, load, names
from perception.posed import triangulate

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
target_of = cache(load)


@pytest.fixture(scope="module", autouse=True)
def as_it_was() -> Iterator[None]:
    """The targets put random points in place of matching and triangulation; the tests of other files want them back."""
    before = dict(vars(triangulate))
    yield
    vars(triangulate).update(before)


def edits(size: int, words: list[str]) -> st.SearchStrategy[list[tuple[int, int, bytes]]]:
    """Places, how many bytes go there, and what takes their place."""
    new = st.one_of(st.binary(max_size=8), st.sampled_from([word.encode("latin-1") for word in words] or [b"\xff"]))
    return st.lists(st.tuples(st.integers(0, size), st.integers(0, 16), new), min_size=1, max_size=4)


@st.composite
def inputs(draw: Any, name: str) -> bytes:
    target = target_of(name)
    if target.decides:
        return draw(st.binary(min_size=8, max_size=64))
    out = bytearray(draw(st.sampled_from(target.seeds())))
    for at, count, new in draw(edits(len(out), list(target.words))):
        out[at : at + count] = new
    return bytes(out[:LONGEST])


@pytest.mark.parametrize("name", names())
def test_the_seeds_are_read(name: str) -> None:
    target = target_of(name)
    assert all(target.run(data) for data in target.seeds())


@pytest.mark.parametrize("name", names())
def test_mutated_inputs_are_read_or_refused(name: str) -> None:
    @settings(max_examples=60, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
    @given(inputs(name))
    def holds(data: bytes) -> None:
        target_of(name).run(data)  # raises for anything but a clean refusal

    holds()


@pytest.mark.parametrize("place", [SHELL - 1, -SHELL])
def test_a_write_past_an_output_is_noticed(place: int) -> None:
    array = guarded((3,), np.float32)
    assert intact(array)
    memory = array
    while isinstance(memory.base, np.ndarray):
        memory = memory.base
    memory[place] ^= 1
    assert not intact(array)


def test_core_inputs_reach_every_function() -> None:
    """Random decisions carry some calls out and have some refused."""
    rng, target = np.random.default_rng(0), CoreTarget()
    results = [target.run(rng.bytes(64)) for _ in range(300)]
    assert any(results) and not all(results)
