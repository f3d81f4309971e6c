"""A Progress that remembers."""

from __future__ import annotations

from perception.progress import Progress


class Told(Progress):
    """updates: (stage, done, total) in order; lines: what was logged."""

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.updates: list[tuple[str, int, int]] = []
        self.lines: list[str] = []

    def update(self, stage: str, done: int, total: int, *words: str) -> None:
        self.updates.append((stage, done, total))

    def log(self, text: str) -> None:
        self.lines.append(text)
