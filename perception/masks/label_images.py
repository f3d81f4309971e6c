"""Label images on disk: one compressed 16-bit PNG per photo, written atomically.

Each PNG stores a key computed from its inputs (source, photo, undistortion). A second run skips photos with an
unchanged key.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.documents import safe_name
from perception.io.memory import Keep
from perception.masks.builtin import BuiltinSegmentation
from perception.masks.merging import Segmentation
from perception.masks.source import MaskSource
from perception.progress import Progress
from perception.types import View

SEGMENTATION = "segmentation.npz"
_KEY = "perception-masks"
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def compute_masks(
    views: list[View],
    source: MaskSource,
    load_photo: Callable[[View], np.ndarray],
    folder: Path,
    progress: Progress | None = None,
    load_depth: Callable[[View], np.ndarray] | None = None,
    depth_key: str = "",
    keep: Keep = np.asarray,
) -> dict[str, Any]:
    """Writes the label image of every view below `folder`, skipping up-to-date files, and SEGMENTATION if the source
    finds segments of a surface. Returns a report.

    load_photo: view -> [h, w, 3] uint8 RGB, undistorted. load_depth: view -> [h, w] z-depth, 0 = none; required by
    BuiltinSegmentation. depth_key: a string that changes whenever the depth changes. keep: where its images are kept.
    Report: source, identity, photos, skipped, seconds, masks (mean per photo), empty (names), warnings.
    """
    warnings = source.check(views)
    start, skipped, counts = perf_counter(), 0, list[int]()
    if isinstance(source, BuiltinSegmentation):
        if load_depth is None:
            raise ValueError(f"masks from {source.name} need load_depth")
        if any(stored_key(label_file(folder, view)) != _key(view, source, depth_key) for view in views):
            found = source.survey(views, load_photo, load_depth, progress, keep)
            (folder / SEGMENTATION).unlink(missing_ok=True)
            if found is not None:
                folder.mkdir(parents=True, exist_ok=True)
                np.savez(folder / SEGMENTATION, **vars(found))

    def masks_of(view: View) -> tuple[int, bool]:
        """Number of masks in the view's label image, and whether it was there already."""
        key, file = _key(view, source, depth_key), label_file(folder, view)
        known = stored_key(file) == key
        if known:
            labels = load_labels(folder, view)
        else:
            labels = source.label_image(view, load_photo(view))
            write_labels(file, labels, key)
        return len(np.setdiff1d(labels, [0])), known

    with ThreadPoolExecutor(getattr(source, "photos_at_once", 1)) as pool:
        for done, (count, known) in enumerate(pool.map(masks_of, views), start=1):
            counts.append(count)
            skipped += known
            if progress is not None:
                progress.update(f"masks ({source.name})", done, len(views))
    empty = [view.name for view, count in zip(views, counts, strict=True) if not count]
    if empty:
        warnings = [*warnings, f"masks from {source.name}: nothing was found in {len(empty)} photos ({empty[0]}, …)"]
    return {
        "source": source.name,
        "identity": source.identity,
        "photos": len(views),
        "skipped": skipped,
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
    return Segmentation(**read_npz(file, file, "remove it"))  # type: ignore[arg-type]


def label_file(folder: Path, view: View) -> Path:
    """Path of a view's label image. The photo's suffix is kept, because `a.jpg` and `a.png` may both exist."""
    return folder / f"{safe_name(view.name, view.photo)}.png"


def load_labels(folder: Path, view: View) -> np.ndarray:
    """[h, w] int32 as written by compute_masks, 0 = unlabelled."""
    file = label_file(folder, view)
    if not file.is_file():
        raise InputError(f"{file}: no label image for photo {view.name}; run the masks stage again")
    width, height, *_ = read_png_header(file)  # a corrupt size field must not allocate gigabytes
    if width * height > 4 * view.width * view.height:
        raise InputError(f"{file}: {width}×{height} pixels of a smaller photo; the PNG is damaged")
    return read_labels(file)


def write_labels(file: Path, labels: np.ndarray, key: str = "") -> None:
    """labels: [h, w] integers ≥ 0. Ids that exceed 16 bit are renumbered from 1."""
    from PIL import Image, PngImagePlugin

    if labels.max(initial=0) > 65535:
        unique, inverse = np.unique(labels, return_inverse=True)
        labels = inverse.reshape(labels.shape) + int(unique[0] != 0)
    if labels.min(initial=0) < 0 or labels.max(initial=0) > 65535:
        raise ValueError(f"{file}: labels must lie in 0..65535, found {labels.min()}..{labels.max()}")
    info = PngImagePlugin.PngInfo()
    info.add_text(_KEY, key)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            Image.fromarray(labels.astype(np.uint16)).save(temporary, "PNG", compress_level=4, pnginfo=info)
            temporary.replace(file)
        finally:
            with suppress(OSError):  # on a read-only disk the first error is the one to report
                temporary.unlink()
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror or error})") from error


def stored_key(file: Path) -> str | None:
    """The key that a label image was written with; None if the file or the key cannot be read."""
    from perception.photos.decode import decode, open_photo

    try:
        with open_photo(file) as image:
            decode(image, file)
            return str(image.info.get(_KEY))
    except InputError:
        return None


def _key(view: View, source: MaskSource, depth_key: str) -> str:
    """A short digest of everything that a label image depends on."""
    digest = hashlib.sha256(f"{source.identity}\n{view.name} {view.width} {view.height} {view.lens}\n".encode())
    digest.update(depth_key.encode())
    digest.update(np.ascontiguousarray(view.K, dtype=np.float64).tobytes())
    if view.photo.is_file():
        status = view.photo.stat()
        digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
    return digest.hexdigest()[:32]


def read_png_header(file: Path) -> tuple[int, int, int, int]:
    """Width and height in pixels, bits per sample, colour type (PNG's numbers), from the first 26 bytes of the file."""
    with file.open("rb") as stream:
        head = stream.read(26)
    if len(head) < 26 or not head.startswith(_SIGNATURE):
        raise InputError(f"{file}: not a PNG; label images are PNG, 8 or 16 bit, one channel")
    width, height, bits, colour_type = struct.unpack(">IIBB", head[16:26])
    return width, height, bits, colour_type


def read_labels(file: Path) -> np.ndarray:
    """[H, W] int32. Pillow keeps palette indices, whereas OpenCV converts them to colours."""
    from perception.photos.decode import decode, open_photo

    with open_photo(file) as image:
        decode(image, file)
        labels = np.asarray(image)
    if labels.ndim != 2 or labels.dtype.kind not in "biu":
        raise InputError(f"{file}: {labels.dtype} of shape {list(labels.shape)}; a label image has one channel")
    return labels.astype(np.int32)
