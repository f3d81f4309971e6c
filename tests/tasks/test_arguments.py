"""What tasks are given."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest

from perception.pipeline import blocks, photo_tasks
from perception.sfm import feature_tasks, parts, submodels

TASKS = (
    feature_tasks.extract_task,
    feature_tasks.match_task,
    submodels.submodel_task,
    parts.part_task,
    blocks.optimise_block,
    photo_tasks.vote_task,
    photo_tasks.silhouette_task,
)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: str(task.__name__))
def test_a_task_takes_its_folder_alone(task: Callable[..., Any]) -> None:
    """Ray binds arguments by `inspect.signature`, which looks behind a decorator that says what it wraps."""
    inspect.signature(task).bind("folder")
