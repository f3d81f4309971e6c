"""Moves a finished map by a similarity; `perception scale` gives it metres, and z up."""

from __future__ import annotations

from math import factorial
from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import move_box
from perception.config import FrameConfig
from perception.errors import InputError
from perception.frame.gravity import gravity_of_scene
from perception.frame.place import measured_scale, upright
from perception.frame.scale import KnownLength, Measurement, combined, known_length
from perception.geometry import move_points, nearest_rotation, scale_of
from perception.io.map import Map
from perception.io.map_lock import writing
from perception.io.recentre import map_from_input, moved
from perception.io.store import read_map, write_map
from perception.types import OrientedBox

CENTROID_ERROR, CLICK_ERROR = 0.05, 1.0
"""Standard deviations of a place in a map: of a centroid in extents of its instance (a part may be unseen), and of a
chosen point in median sizes of a Gaussian."""
SOLID = 0.5  # least opacity of the Gaussians whose means are surface points


def scale_map(
    path: Path, output: Path | None, options: FrameConfig, level: bool = False, improve: bool = False
) -> dict[str, Any]:
    """Writes the map at `path` in metres to `output` (None: in place); level: also turned z up, as `placed_scene`.

    The unit is measured by `options` (a known length also between instances or points) and by GPS of the photos.
    Returns {"map", "factor", "scale", "gravity", "notes"}. InputError when nothing tells the unit or the vertical;
    with `improve` also when the map is in metres already with a smaller standard error, or without any stated.
    """
    target = output or path
    if output is not None and output.exists():
        raise InputError(f"{output}: exists already; choose another -o or remove it first")
    with writing(target):
        gmap = read_map(path)
        scale, notes = _measured(gmap, options)
        factor, error = scale.metres, scale.standard_error / scale.metres
        stated = (gmap.info.get("scale") or {}).get("standard_error")
        if improve and gmap.metric and (stated is None or stated <= error):
            known = "as its input states" if stated is None else f"within ± {stated:.1%}"
            raise InputError(
                f"{path}: is in metres already, {known}, and this length only within ± {error:.1%}; `perception scale` "
                "replaces the unit all the same"
            )
        b_from_a = np.diag([factor, factor, factor, 1.0])
        info = {**gmap.info, "metric": True}
        info["scale"] = Measurement(1.0, error, scale.source).to_json()
        if level:
            solid = gmap.means[gmap.opacities >= SOLID].astype(np.float64)
            gravity = gravity_of_scene(gmap.poses, solid)
            if gravity is None or not gravity.confident:
                raise InputError(f"{path}: gravity is not known well enough to turn the map; leave out --level")
            b_from_a = upright(gmap.views[0].camera_from_world, solid, gravity, factor)
            info["gravity"] = gravity.to_json()
        changed = transformed(Map.of(gmap, info=info), b_from_a)
        write_map(target, changed)
    return {
        "map": str(target),
        "factor": factor,
        "scale": changed.info["scale"],
        "gravity": changed.info.get("gravity"),
        "notes": notes,
    }


def transformed(gmap: Map, b_from_a: np.ndarray) -> Map:
    """The map in frame b: Gaussians, instances, parts and views; b_from_a [4, 4] is a similarity.

    Harmonics are turned as well, so that renders from moved cameras stay the same. map.json's gravity is turned, and
    map_from_input continued if the input had poses.
    """
    scale, rotation = scale_of(b_from_a), nearest_rotation(b_from_a[:3, :3])
    means = move_points(b_from_a, gmap.means)
    info = dict(gmap.info)
    if "map_from_input" in info or info.get("scene", {}).get("input") != "photos":
        info["map_from_input"] = (b_from_a @ map_from_input(gmap.path or Path("map"), info)).tolist()
    if info.get("gravity"):
        down = rotation @ info["gravity"]["direction"]
        info["gravity"] = {**info["gravity"], "direction": down.tolist()}
    turned = not np.array_equal(rotation, np.eye(3))
    part_ids = gmap.parts.get("ids", np.empty(0, np.int32))

    def entry(old: dict[str, Any], ids: np.ndarray) -> dict[str, Any]:
        inside = means[ids == old["id"]]
        new = {**old, "centroid": move_points(b_from_a, np.array(old["centroid"])).tolist()}
        new["obb"] = move_box(b_from_a, OrientedBox.from_json(old["obb"])).to_json()
        new["aabb"] = {"min": inside.min(axis=0).tolist(), "max": inside.max(axis=0).tolist()}
        if "parts" in old:
            new["parts"] = [entry(part, part_ids) for part in old["parts"]]
        return new

    return Map.of(
        gmap,
        means=means,
        quats=_turned_quaternions(rotation, gmap.quats) if turned else gmap.quats,
        log_scales=(gmap.log_scales + np.log(scale)).astype(np.float32),
        sh=_turned_harmonics(rotation, gmap.sh) if turned else gmap.sh,
        instances=[entry(old, gmap.instance_ids) for old in gmap.instances],
        views=[moved(view, b_from_a) for view in gmap.views],
        info=info,
    )


def _measured(gmap: Map, options: FrameConfig) -> tuple[Measurement, list[str]]:
    length = None if options.known_length is None else known_length(options.known_length)
    found = []
    if length is not None and length.pixels is None:
        found.append(_between(gmap, length))
        options = options.model_copy(update={"known_length": None})
    views = gmap.located_views()
    if options.tag_size is not None or options.board is not None:
        views = [gmap.with_photo(view) for view in gmap.views]
    other, notes = measured_scale(views, np.empty((0, 3)), options)
    scale, warnings = combined([*found, *([] if other is None else [other])])
    if scale is None:
        raise InputError(
            f"{gmap.path}: nothing tells its unit; give --known-length, --tag-size or --board" + "".join(notes)
        )
    return scale, [*notes, *warnings]


def _between(gmap: Map, length: KnownLength) -> Measurement:
    """Metres per unit by a length between two instances or two points of the map."""
    if length.names is not None:
        entries = [_instance(gmap, name) for name in length.names]
        places = np.array([each["centroid"] for each in entries])
        errors = [CENTROID_ERROR * float(np.mean(each["obb"]["extent"])) for each in entries]
        source = f"known length {length.metres:g} m between {' and '.join(length.names)}"
    else:
        assert length.points is not None
        places, source = length.points, f"known length {length.metres:g} m between two points"
        errors = [CLICK_ERROR * float(np.median(gmap.scales.max(axis=1)))] * 2
    units = float(np.linalg.norm(places[0] - places[1]))
    error = float(np.linalg.norm(errors))
    if units <= 3 * error:
        raise InputError(f"known length: its ends are {units:.3g} map units apart, too near each other to measure by")
    metres = length.metres / units
    return Measurement(metres, metres * error / units, source)


def _instance(gmap: Map, name: str) -> dict[str, Any]:
    alike = [e for e in gmap.instances if name in (str(e["id"]), e.get("label"))]
    if len(alike) != 1:
        raise InputError(f"known length: {len(alike)} instances are called '{name}'; expected one label or id")
    return alike[0]


def _turned_quaternions(rotation: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """wxyz [N, 4] of `rotation` times the rotations of `quats` [N, 4] wxyz."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    a, b = quats[:, :1].astype(np.float64), quats[:, 1:].astype(np.float64)
    axis = np.array([x, y, z])
    return np.hstack([w * a - b @ axis[:, None], w * b + a * axis + np.cross(axis, b)]).astype(np.float32)


def _turned_harmonics(rotation: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """Coefficients [N, K, 3] of the functions turned by `rotation`: f'(d) = f(Rᵀ d), solved at sampled directions."""
    degree = round(np.sqrt(sh.shape[1])) - 1
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = np.linalg.lstsq(_basis(degree, directions), _basis(degree, directions @ rotation), rcond=None)[0]
    return np.einsum("kl,nlc->nkc", turn, sh.astype(np.float64)).astype(np.float32)


def _basis(degree: int, directions: np.ndarray) -> np.ndarray:
    """Real spherical harmonics with the Condon-Shortley phase [M, (degree + 1)²] at unit vectors [M, 3], as 3DGS."""
    from scipy.special import lpmv  # with the Condon-Shortley phase

    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            norm = np.sqrt((2 * n + 1) / (4 * np.pi) * factorial(n - k) / factorial(n + k) * (1 if m == 0 else 2))
            columns.append(
                norm * lpmv(k, n, directions[:, 2]) * (np.sin(k * azimuth) if m < 0 else np.cos(k * azimuth))
            )
    return np.stack(columns, axis=1)
