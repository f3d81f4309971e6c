"""`perception upgrade`: embeds the instances of a map with the current encoder and reads printed texts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.gaussians.model import as_gaussians
from perception.gaussians.photos import training_view
from perception.instances.describe import Load, describe_instances
from perception.instances.silhouettes import render_silhouettes
from perception.instances.texts import read_texts, store_texts
from perception.language.base import Encoder, reading_of
from perception.language.description import from_arrays, to_arrays
from perception.language.encoders import make_encoder
from perception.language.ocr import TextReader, make_reader
from perception.map.history import stood
from perception.map.map import MAX_SIDE, Map, language_in, prefixed
from perception.map.replace import writing
from perception.map.write import read_map, write_map
from perception.photos.view_json import locate_photo
from perception.progress import QUIET, Progress
from perception.query.text_ranking import encoder_of


def upgrade_map(
    path: Path,
    output: Path | None = None,
    *,
    encoders: Callable[[str], Encoder | None] = make_encoder,
    progress: Progress = QUIET,
) -> dict[str, Any]:
    """Writes the map at `path` anew, to `output` or in place; Gaussians, instances and labels are kept.

    If the embeddings are from another encoder than the one its settings now select, all instances are embedded again,
    from their recorded photos and rendered silhouettes; InputError names the first missing photo. Printed texts are
    read if the extra ocr is installed, the map has none from this reader, and its photos are there.
    Returns {"map", "encoder": [before, after]}.
    """
    target = output or path
    if output is not None and output.exists():
        raise InputError(f"{output}: exists already; choose another -o or remove it first")
    with writing(target):
        gmap = read_map(path)
        old = str(gmap.language["encoder"]) if gmap.language else None
        encoder = encoder_of(gmap, encoders) if gmap.language else None
        if encoder is not None and encoder.identity != old:
            _embed_again(gmap, encoder, progress)
        _read_again(gmap, make_reader(gmap.setting("language", "texts", "auto")), progress)
        write_map(target, gmap, keep_report=True, fresh=output is not None)
    new = str(gmap.language["encoder"]) if gmap.language else None
    return {"map": str(target), "encoder": [old, new]}


def _embed_again(gmap: Map, encoder: Encoder, progress: Progress) -> None:
    """Replaces `language` and, if present, that of the parts and groups."""
    names = [view.name for view in gmap.views]

    def described(
        stored: dict[str, np.ndarray], owners: np.ndarray, ids: list[int], zooms: int = 1
    ) -> dict[str, np.ndarray]:
        """Language arrays of the instances `ids`; see `_shown`."""
        choices, load = _shown(gmap, stored, owners, ids)
        return to_arrays(describe_instances(encoder, choices, load, names, zooms, progress), encoder.identity)

    zooms = gmap.setting("language", "zooms", 0) or reading_of(encoder).zooms
    gmap.language = described(gmap.language, gmap.instance_ids, [entry["id"] for entry in gmap.instances], zooms)
    if stored := language_in(gmap.parts):
        owners = gmap.parts["ids"]
        gmap.parts = gmap.parts | prefixed(described(stored, owners, np.unique(owners[owners >= 0]).tolist()))
    if stored := language_in(gmap.groups):
        known = list(range(len(gmap.groups["scores"])))
        gmap.groups = gmap.groups | prefixed(described(stored, gmap.group_ids, known))


def _read_again(gmap: Map, reader: TextReader | None, progress: Progress) -> None:
    """Replaces `texts` of the instances if another reader, or none, has looked for them."""
    report = gmap.info.get("instances", {})
    if reader is None or not gmap.language or report.get("texts") == reader.identity:
        return
    try:
        choices, load = _shown(gmap, gmap.language, gmap.instance_ids, [entry["id"] for entry in gmap.instances])
    except InputError as error:
        progress.log(f"warning: printed texts are not read: {error}")
        return
    store_texts(gmap.instances, read_texts(reader, choices, load, progress))
    gmap.info["instances"] = {**report, "texts": reader.identity}


def _shown(
    gmap: Map, stored: dict[str, np.ndarray], owners: np.ndarray, ids: list[int]
) -> tuple[list[np.ndarray], Load]:
    """The views that `stored` lists for each of the instances `ids`, and what loads them (see `describe_instances`).

    owners: [N] instance id of each Gaussian, −1 = none. An instance that stood elsewhere when a photo was taken is
    shown there by its recorded box. Raises InputError for a missing photo, before any is loaded.
    """
    descriptions, _ = from_arrays(stored)
    number = {view.name: n for n, view in enumerate(gmap.views)}
    unknown = [name for d in descriptions for name in d.views if name not in number]
    if unknown:
        found = f"lists the photo {unknown[0]!a}, which is none of its views"
        raise InputError(f"{gmap.path}: {found}; build the map again")
    wanted = sorted({number[name] for d in descriptions for name in d.views})
    located = {n: replace(gmap.views[n], photo=locate_photo(gmap.views[n], gmap.path)) for n in wanted}
    gaussians, side = as_gaussians(gmap), gmap.setting("photos", "max_side", MAX_SIDE)
    rank = {instance: n for n, instance in enumerate(ids)}
    positions = np.array([rank.get(int(i), -1) for i in owners], np.int32)
    entries = [entry for entry in gmap.instances if owners is gmap.instance_ids and entry.get("past")]

    def load(n: int) -> tuple[np.ndarray, np.ndarray]:
        view = training_view(located[n], side)
        height, width = view.photo.shape[:2]
        seen = render_silhouettes(gaussians, [positions], view.camera_from_world, view.K, width, height)[0]
        shown = seen.ids.copy()
        for entry in entries:
            row, name = rank[entry["id"]], gmap.views[n].name
            if name in descriptions[row].views and stood(entry, getattr(gmap.views[n], "visit", 0)) is not entry:
                x0, y0, x1, y1 = descriptions[row].boxes[descriptions[row].views.index(name)]
                shown[shown == row] = -1
                shown[y0:y1, x0:x1] = row
        return view.photo.numpy(), shown

    return [np.array([number[name] for name in d.views], np.int64) for d in descriptions], load
