"""The parts of `bench query` on a small map: right answers are found right, lost and crossed ones are counted."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from perception.bench.clients import Best, Served, by_engine
from perception.bench.query import clients_at_once, open_map_times, shares_of, warm
from perception.io.store import read_map
from support.query_maps import NAMES, encoders, write_map_of


def test_the_bench_finds_every_answer_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("text_ranking", "engine"):
        monkeypatch.setattr(f"perception.query.{module}.make_encoder", encoders)
    path = write_map_of(tmp_path / "a.gsmap", gaussians=600)
    facts, answers = warm(path, NAMES, 30)
    assert facts["present"] == f"{len(NAMES)} of {len(NAMES)}"
    ids = read_map(path).instance_ids
    assert answers == {name: (n, int((ids == n).sum())) for n, name in enumerate(NAMES)}
    row = clients_at_once(by_engine, path, answers, shares_of(NAMES, 80, 4))
    assert (row["asked"], row["lost"], row["crossed"]) == (80, 0, 0)
    assert min(open_map_times(path, 2).values()) > 0


def test_lost_and_crossed_answers_are_counted(tmp_path: Path) -> None:
    """A server that loses every fourth answer and gives every fifth to the wrong question."""
    path = write_map_of(tmp_path / "a.gsmap", gaussians=100)
    answers: dict[str, Best] = {name: (number, 1) for number, name in enumerate(NAMES)}
    count = [0]

    @contextmanager
    def broken(path: Path) -> Iterator[Served]:
        def ask(text: str) -> Best:
            count[0] += 1
            if count[0] % 4 == 0:
                raise ConnectionResetError
            return (99, 1) if count[0] % 5 == 0 else answers[text]

        yield Served(lambda: ask, os.getpid())

    row = clients_at_once(broken, path, answers, shares_of(NAMES, 60, 1))
    assert (row["asked"], row["lost"], row["crossed"]) == (60, 15, 9)
