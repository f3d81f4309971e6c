"""`labels:DIR`: label images from other tools, one PNG per photo, at the size of the original (distorted) photo."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from perception.errors import InputError
from perception.io.documents import safe_name
from perception.masks.base import MaskSource
from perception.masks.label_files import read_labels, read_png_header
from perception.photos.named_files import NamedFiles
from perception.types import View

_COLOUR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}


class LabelFolder(MaskSource):
    """Label images read from a folder. The photo `a/0001.jpg` uses `a/0001.png`, or `0001.png` if stems are unique.
    Format: 8 or 16 bit grey, or an 8-bit palette whose index is the label. 0 = unlabelled."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError(f"labels:{folder}: no such folder; expected one PNG per photo in it")
        self._pngs = sorted(file for file in folder.rglob("*") if file.suffix.lower() == ".png")
        if not self._pngs:
            raise InputError(f"labels:{folder}: holds no PNG; expected a label image for each photo")
        digest = hashlib.sha256()
        for file in self._pngs:
            status = file.stat()
            digest.update(f"{file.relative_to(folder)} {status.st_size} {status.st_mtime_ns}\n".encode())
        self.name, self.folder, self.identity = "labels", folder, f"labels {digest.hexdigest()[:16]}"
        self._files: dict[str, Path] = {}
        self._named = NamedFiles(folder)

    def check(self, views: list[View]) -> list[str]:
        """Checks that every view has a label image of its photo's size. Label images without a view give a warning."""
        sharing = Counter(PurePosixPath(view.name).stem for view in views)
        self._files = {view.name: file for view in views if (file := self._find(view, sharing)) is not None}
        missing = [view.name for view in views if view.name not in self._files]
        if missing:
            advice = "expected a PNG of the same stem for each photo (all zero where nothing is labelled)"
            raise InputError(f"labels:{self.folder}: {_some(missing)} without a label image; {advice}")
        for view in views:
            _check_header(self._files[view.name], *view.photo_size)
        used = set(self._files.values())
        # No warning for photos that were kept out of training or not registered.
        folders = {view.photo.parent for view in views if view.photo.parent.is_dir()} - {self.folder}
        photos = {file.stem for folder in folders for file in folder.iterdir()}
        left = (file for file in self._pngs if file not in used)
        extra = [str(file.relative_to(self.folder)) for file in left if file.stem not in photos]
        if extra:
            return [f"labels:{self.folder}: {_some(extra)} belong to no photo of the map and are ignored"]
        return []

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] undistorted; only its size is used. Returns [h, w] int32."""
        from perception.photos.decode import warp_labels

        file = self._files.get(view.name) or self._find(view)
        if file is None:
            raise InputError(f"labels:{self.folder}: no label image for photo {view.name}")
        _check_header(file, *view.photo_size)
        height, width = photo.shape[:2]
        return warp_labels(view, read_labels(file), width, height)

    def _find(self, view: View, sharing: Mapping[str, int] | None = None) -> Path | None:
        """sharing: number of photos of each stem; None: there are no other photos."""
        name = PurePosixPath(safe_name(view.name, f"labels:{self.folder}")).with_suffix(".png")
        alone = sharing is None or sharing[name.stem] == 1
        return self._named.find(str(name)) or (self._named.find(name.name) if alone else None)


def _check_header(file: Path, width: int, height: int) -> None:
    """InputError unless the PNG has one channel of 8 or 16 bit, or a palette, and that size."""
    *size, bits, colour_type = read_png_header(file)
    kind = _COLOUR_TYPES.get(colour_type, f"colour type {colour_type}")
    if kind != "palette" and (kind != "grey" or bits not in (8, 16)):
        raise InputError(f"{file}: a {bits}-bit {kind} image; a label image has one channel of 8 or 16 bit")
    if size != [width, height]:
        both = f"{size[0]}×{size[1]} pixels, but its photo has {width}×{height}"
        raise InputError(f"{file}: {both}; label images have the size of the original photo")


def _some(names: list[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
