"""Masks: one label image per photo, from the user's files, a SAM model, or a segmentation without learned weights."""

from __future__ import annotations

from perception.masks.label_images import compute_masks, load_labels
from perception.masks.source import MaskSource, make_source

__all__ = ["MaskSource", "compute_masks", "load_labels", "make_source"]
