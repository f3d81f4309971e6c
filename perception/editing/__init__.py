"""Manual corrections of a map: rename, hide, merge, split, remove; with undo, redo and save."""

from perception.editing.editor import Editor

__all__ = ["Editor"]
