"""`perception export --splat`: the Gaussians of a map as a PLY for any viewer, with the instance of each, all of them
or chosen ones."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.ply import map_ply, ply_tables, write_ply
from perception.map.history import is_removed
from perception.map.map import Map
from perception.map.outputs import refuse_inputs

ID = "instance_id"


def export_splat(
    map_path: Path,
    output: Path,
    only: Sequence[int] = (),
    without: Sequence[int] = (),
    each: bool = False,
    inputs: Sequence[Path | None] = (),
) -> tuple[dict[str, Any], str]:
    """Writes the rows of a map's Gaussians in their order, their properties byte for byte, and instance_id int32,
    −1 = none. only, without: ids of the instances that are written, or left out. each: a file for every instance
    (of `only`), OUT-ID.ply. A map of a splat gives back the properties of its file that no map holds, if the file lies
    where it lay. inputs: files that this must not write. Returns (facts, text). InputError for an unknown id, and for a
    file that lies at OUT-ID.ply and has no instance_id."""
    if output.suffix.lower() != ".ply":
        raise InputError(f"{output}: expected a file OUT.ply for --splat; -o OUT.spz writes compressed Gaussians")
    gmap = Map.open(map_path)
    ids = gmap.instance_ids
    known = [entry["id"] for entry in gmap.instances if not is_removed(entry)]
    for number in (*only, *without):
        if number not in known:
            raise InputError(f"{map_path}: has no Gaussians of an instance {number}; `perception query` tells ids")
    rows = _rows(gmap)
    wanted = [number for number in only or known if number not in without]
    files = {output: np.isin(ids, wanted) if only else ~np.isin(ids, without)}
    if each:
        files = {output.with_name(f"{output.stem}-{number}.ply"): ids == number for number in wanted}
        for file in filter(os.path.lexists, files):  # the user named none of them
            if not _is_export(file):
                raise InputError(f"{file}: lies there, and is of no such export; choose another name for --splat")
    refuse_inputs(files, [map_path, *inputs])
    written = {}
    for file, mask in files.items():
        columns = {name: np.ascontiguousarray(rows[name][mask]) for name in rows.dtype.names or () if name != ID}
        write_ply(file, {"vertex": {**columns, ID: ids[mask].astype(np.int32)}})
        written[str(file)] = int(mask.sum())
    lines = [f"{file}: {count} of {len(ids)} Gaussians" for file, count in written.items()]
    return {"splat": written, "gaussians": len(ids)}, "\n".join(lines)


def _is_export(file: Path) -> bool:
    with contextlib.suppress(InputError):
        return file.is_file() and any(p.name == ID for table in ply_tables(file) for p in table.properties)
    return False


def _rows(gmap: Map) -> np.ndarray:
    """The rows of the map's Gaussians: of the input's file where these are the same but for rows that are no numbers,
    which a map does not hold; else of the map."""
    assert gmap.files is not None  # for the type checker
    own = gmap.files.rows
    source = Path(str(gmap.info.get("source", "")))
    if gmap.info.get("scene", {}).get("input") != "splat" or not source.is_file():
        return own
    try:
        given = map_ply(source, "vertex")
    except InputError:
        return own  # another coding, or no longer that file
    names = [name for name in own.dtype.names or () if name in (given.dtype.names or ()) and name[0] != "n"]
    if len(given) != len(own) or "x" not in names:
        return own
    parked = np.zeros(len(own), bool)
    for name in names:
        parked |= ~np.isfinite(given[name])
    same = all(bool(((given[name] == own[name]) | parked).all()) for name in names)
    return given if same else own
