"""Corrections by hand: rename, hide, merge, split, remove, delete floaters; undone, saved, repeated on a newer map."""

from perception.editing.changes import isolated
from perception.editing.editor import Editor

__all__ = ["Editor", "isolated"]
