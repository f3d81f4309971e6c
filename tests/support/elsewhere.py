"""An engine that runs tasks as a cluster does, from nothing but their folders."""

from __future__ import annotations

from typing import Any

from perception.progress import Progress
from perception.tasks.engine import Engine


class Elsewhere(Engine):
    """Runs each task twice, here, the first time in backward order. asked: number of tasks of each call so far."""

    def __init__(self) -> None:
        super().__init__("ray")
        object.__setattr__(self, "asked", [])

    asked: list[int]

    def run(self, task: Any, items: Any, what: str, progress: Progress, each_core: bool = False) -> list[Any]:
        self.asked.append(len(items))
        for item in [*reversed(items), *items]:
            task(item)
        return [None] * len(items)
