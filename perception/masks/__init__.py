"""Masks: one label image per photo, from the user's files, a SAM model, or a segmentation without learned weights."""

from __future__ import annotations

from perception.masks.base import MaskSource
from perception.masks.compute import compute_masks
from perception.masks.label_files import load_labels
from perception.masks.sources import make_source

__all__ = ["MaskSource", "compute_masks", "load_labels", "make_source"]
