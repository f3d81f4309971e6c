"""`perception scale`: a finished map in metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import move_box
from perception.config import FrameConfig
from perception.errors import InputError
from perception.frame.recentre import map_from_input, moved
from perception.frame.scale import KnownLength, Measurement, combined, known_length
from perception.frame.world_frame import measured_scale
from perception.geometry import move_points
from perception.map.history import is_removed
from perception.map.map import Map
from perception.map.replace import writing
from perception.map.write import read_map, write_map
from perception.types import OrientedBox

CENTROID_ERROR, CLICK_ERROR = 0.05, 1.0
"""Standard deviations of a position in a map: of a centroid in extents of its instance (a part may be unseen), and of a
chosen point in median sizes of a Gaussian."""


def scale_map(path: Path, output: Path | None, options: FrameConfig, improve: bool = False) -> dict[str, Any]:
    """Writes the map at `path` in metres to `output` (None: in place).

    The unit is measured by `options` (a known length also between instances or points) and by GPS of the photos.
    Returns {"map", "factor", "scale", "gravity", "notes"}. InputError when nothing gives the unit; with `improve` also
    when the map is in metres already with a smaller standard error, or without any stated.
    """
    target = output or path
    if output is not None and output.exists():
        raise InputError(f"{output}: exists already; choose another -o or remove it first")
    with writing(target):
        gmap = read_map(path)
        scale, notes = _measured(gmap, options)
        error = scale.standard_error / scale.metres
        stated = (gmap.info.get("scale") or {}).get("standard_error")
        if improve and gmap.metric and (stated is None or stated <= error):
            known = "as its input states" if stated is None else f"within ± {stated:.1%}"
            found = f"is in metres already, {known}, and this length only within ± {error:.1%}"
            raise InputError(f"{path}: {found}; `perception scale` replaces the unit all the same")
        entry = Measurement(1.0, error, scale.source).to_json()
        info = {**gmap.info, "metric": True, "scale": entry}
        write_map(target, scaled(Map.of(gmap, info=info), scale.metres), fresh=output is not None)
    gravity = info.get("gravity")
    return {"map": str(target), "factor": scale.metres, "scale": entry, "gravity": gravity, "notes": notes}


def scaled(gmap: Map, factor: float) -> Map:
    """The map with all lengths times `factor`: Gaussians, instances with their history, parts, views, errors of depth,
    boxes of blocks. map.json's map_from_input is continued if the input had poses."""
    b_from_a = np.diag([factor, factor, factor, 1.0])
    info = dict(gmap.info)
    if "map_from_input" in info or info.get("scene", {}).get("input") != "photos":
        info["map_from_input"] = (b_from_a @ map_from_input(gmap.path or Path("map"), info)).tolist()
    if (depth := info.get("quality", {}).get("depth") or {}).get("unit") == "m":
        lengths = {name: factor * depth[name] for name in ("median", "tolerance")}
        info["quality"] = {**info["quality"], "depth": {**depth, **lengths}}
    if "blocks" in info:  # their boxes are infinite at the outside
        corners = [[[x and factor * x for x in corner] for corner in block["box"]] for block in info["blocks"]]
        info["blocks"] = [{**block, "box": box} for block, box in zip(info["blocks"], corners, strict=True)]

    def entry(old: dict[str, Any]) -> dict[str, Any]:
        new = {**old, "centroid": (factor * np.array(old["centroid"])).tolist()}
        new["obb"] = move_box(b_from_a, OrientedBox.from_json(old["obb"])).to_json()
        if "aabb" in old:
            new["aabb"] = {end: (factor * np.array(corner)).tolist() for end, corner in old["aabb"].items()}
        for key in ("parts", "past"):
            if key in old:
                new[key] = [entry(one) for one in old[key]]
        if (motion := old.get("transform")) is not None:
            new["transform"] = (b_from_a @ np.array(motion) @ np.linalg.inv(b_from_a)).tolist()
        return new

    past = {**gmap.past, "means": move_points(b_from_a, gmap.past["means"])} if gmap.past else {}
    if "log_scales" in past:
        past["log_scales"] = (past["log_scales"] + np.log(factor)).astype(past["log_scales"].dtype)
    return Map.of(
        gmap,
        means=move_points(b_from_a, gmap.means),
        log_scales=(gmap.log_scales + np.log(factor)).astype(np.float32),
        instances=[entry(old) for old in gmap.instances],
        past=past,
        views=[moved(view, b_from_a) for view in gmap.views],
        info=info,
    )


def _measured(gmap: Map, options: FrameConfig) -> tuple[Measurement, list[str]]:
    length = None if options.known_length is None else known_length(options.known_length)
    measured = []
    if length is not None and length.pixels is None:
        measured.append(_between(gmap, length))
        options = options.model_copy(update={"known_length": None})
    views = gmap.located_views()
    if options.tag_size is not None or options.board is not None:
        views = [gmap.with_photo(view) for view in gmap.views]
    other, notes = measured_scale(views, np.empty((0, 3)), options)
    scale, warnings = combined(measured if other is None else [*measured, other])
    if scale is None:
        give = "give --known-length, --tag-size or --board"
        raise InputError(f"{gmap.path}: nothing tells its unit; {give}" + "".join(notes))
    return scale, [*notes, *warnings]


def _between(gmap: Map, length: KnownLength) -> Measurement:
    """Metres per unit by a length between two instances or two points of the map."""
    if length.names is not None:
        entries = [_instance(gmap, name) for name in length.names]
        ends = np.array([each["centroid"] for each in entries])
        errors = [CENTROID_ERROR * float(np.mean(each["obb"]["extent"])) for each in entries]
        source = f"known length {length.metres:g} m between {' and '.join(length.names)}"
    else:
        assert length.points is not None
        ends, source = length.points, f"known length {length.metres:g} m between two points"
        errors = [CLICK_ERROR * float(np.median(gmap.scales.max(axis=1)))] * 2
    units = float(np.linalg.norm(ends[0] - ends[1]))
    error = float(np.linalg.norm(errors))
    if units <= 3 * error:
        raise InputError(f"known length: its ends are {units:.3g} map units apart, too near each other to measure by")
    metres = length.metres / units
    return Measurement(metres, metres * error / units, source)


def _instance(gmap: Map, name: str) -> dict[str, Any]:
    alike = [e for e in gmap.instances if name in (str(e["id"]), e.get("label")) and not is_removed(e)]
    if len(alike) != 1:
        raise InputError(f"known length: {len(alike)} instances are called '{name}' today; expected one label or id")
    return alike[0]
