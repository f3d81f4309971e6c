"""Manual corrections of a map: rename, hide, merge, split, remove, delete floaters; with undo, redo and save."""

from perception.editing.changes import isolated
from perception.editing.editor import Editor

__all__ = ["Editor", "isolated"]
