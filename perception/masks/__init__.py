"""Masks: one label image per photo, from the user's files, a SAM model, or a segmentation without weights."""

from __future__ import annotations

from perception.masks.source import MaskSource, make_source

__all__ = ["MaskSource", "make_source"]
