"""Makes the label images of all photos by a mask source. Photos whose image has the key of the same inputs (source,
photo, undistortion, depth) are skipped.
"""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from perception.io.arrays import read_npz
from perception.io.memory import Keep
from perception.masks.base import LoadImage, MaskSource
from perception.masks.label_files import label_file, load_labels, stored_key, write_labels
from perception.masks.merging import Segmentation
from perception.progress import QUIET, Progress
from perception.types import View

SEGMENTATION = "segmentation.npz"


def compute_masks(
    views: list[View],
    source: MaskSource,
    load_photo: LoadImage,
    folder: Path,
    progress: Progress = QUIET,
    load_depth: LoadImage | None = None,
    depth_key: str = "",
    keep: Keep = np.asarray,
) -> dict[str, Any]:
    """Writes the label image of every view below `folder`, skipping up-to-date files, and SEGMENTATION if the source
    finds segments of a surface. Returns a report.

    load_depth: required by sources that need depth. depth_key: a string that changes whenever the depth changes.
    keep: where the source's images are held.
    Report: source, identity, photos, skipped, seconds, masks (mean per photo), empty (names), warnings.
    """
    warnings = source.check(views)
    start, counts, known = perf_counter(), list[int](), list[bool]()
    if source.needs_depth:
        if load_depth is None:
            raise ValueError(f"masks from {source.name} need load_depth")
        if any(stored_key(label_file(folder, view)) != _key(view, source, depth_key) for view in views):
            cuts = source.prepare(views, load_photo, load_depth, progress, keep)
            (folder / SEGMENTATION).unlink(missing_ok=True)
            if cuts is not None:
                folder.mkdir(parents=True, exist_ok=True)
                np.savez(folder / SEGMENTATION, **asdict(cuts))

    def masks_of(view: View) -> tuple[int, bool]:
        """Number of masks in the view's label image, and whether it was there already."""
        key, file = _key(view, source, depth_key), label_file(folder, view)
        if there := stored_key(file) == key:
            labels = load_labels(folder, view)
        else:
            labels = source.label_image(view, load_photo(view))
            write_labels(file, labels, key)
        return len(np.setdiff1d(labels, [0])), there

    with ThreadPoolExecutor(source.photos_at_once) as pool:
        for count, there in pool.map(masks_of, views):
            counts.append(count)
            known.append(there)
            progress.update(f"masks ({source.name})", len(counts), len(views))
    empty = [view.name for view, count in zip(views, counts, strict=True) if not count]
    if empty:
        warnings = [*warnings, f"masks from {source.name}: nothing was found in {len(empty)} photos ({empty[0]}, …)"]
    return {
        "source": source.name,
        "identity": source.identity,
        "photos": len(views),
        "skipped": sum(known),
        "seconds": perf_counter() - start,
        "masks": float(np.mean(counts)) if counts else 0.0,
        "empty": empty,
        "warnings": warnings,
    }


def load_segmentation(folder: Path) -> Segmentation | None:
    """The segments of the surface that compute_masks found; None where the source finds none."""
    file = folder / SEGMENTATION
    if not file.is_file():
        return None
    return Segmentation(**read_npz(file, file, f"remove {folder} and go on with --resume"))  # type: ignore[arg-type]


def _key(view: View, source: MaskSource, depth_key: str) -> str:
    """A short digest of everything that a label image depends on."""
    digest = hashlib.sha256(f"{source.identity}\n{view.name} {view.width} {view.height} {view.lens}\n".encode())
    digest.update(depth_key.encode())
    digest.update(np.ascontiguousarray(view.K, dtype=np.float64).tobytes())
    if view.photo.is_file():
        status = view.photo.stat()
        digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
    return digest.hexdigest()[:32]
