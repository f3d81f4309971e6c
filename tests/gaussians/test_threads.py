"""Threads of torch and of the rasterizer while they take turns."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from perception.gaussians.model import Gaussians, Nearby
from perception.machine import torch_on_one_thread
from perception.rasterizer import cpu as module


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch):
    """Function that renders one Gaussian and returns the number of threads that the compiled core was asked for."""
    import perception

    before, found = torch.get_num_threads(), []
    construct = module._compiled

    def spy(name: str, tensor: torch.Tensor):
        function = construct(name, tensor)
        if name != "RasterizerInputs":
            return function
        return lambda **arguments: (found.append(arguments["threads"]), function(**arguments))[1]

    monkeypatch.setattr(module, "_compiled", spy)

    def render(**given) -> int:
        one = torch.ones(1, 3)
        quats, view, k = torch.ones(1, 4), torch.eye(4)[None], torch.eye(3)[None]
        perception.rasterize(one, quats, one, torch.ones(1), one, view, k, 4, 4, **given)
        return found[-1]

    yield render
    torch.set_num_threads(before)


def test_the_rasterizer_keeps_the_threads_that_torch_gives_up(asked) -> None:
    torch.set_num_threads(3)
    assert asked() == 3
    with torch_on_one_thread():
        assert (torch.get_num_threads(), asked(), asked(threads=2)) == (1, 3, 2)
        with torch_on_one_thread():
            assert (torch.get_num_threads(), asked()) == (1, 3)
        assert (torch.get_num_threads(), asked()) == (1, 3)
    assert (torch.get_num_threads(), asked()) == (3, 3)


def test_torch_gets_its_threads_back_after_an_error(asked) -> None:
    torch.set_num_threads(2)
    with pytest.raises(KeyError), torch_on_one_thread():
        raise KeyError
    assert (torch.get_num_threads(), asked()) == (2, 2)


def test_views_are_worked_on_at_a_time_each_on_one_thread_and_given_in_order(monkeypatch) -> None:
    monkeypatch.setattr("perception.machine.cores", lambda: 3)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    none = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (1, 3), (8,))))

    second = threading.Event()

    def at_a_time(view: int) -> tuple[int, int]:
        second.set() if view else second.wait(60)  # the first ends after another has begun
        return view, torch.get_num_threads()

    try:
        assert list(Nearby(none).each(at_a_time, range(9))) == [(view, 1) for view in range(9)]
        of_blocks = Nearby(none, {"0": [np.arange(0)]})
        here = list(of_blocks.each(lambda view: (view, threading.get_ident()), range(9)))
        assert here == [(view, threading.get_ident()) for view in range(9)]
        assert second.is_set() and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
