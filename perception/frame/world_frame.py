"""Puts a scene into the frame of its map: z up, metres, the origin on the floor below the first camera, x ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.calibration.board import Board
from perception.config import FrameConfig
from perception.errors import InputError
from perception.frame.gravity import Gravity, floor_height, gravity_of_scene
from perception.frame.known_size import scale_of_board, scale_of_pixels, scale_of_tags
from perception.frame.recentre import moved_scene
from perception.frame.scale import KnownLength, Measurement, combined, known_length, scale_of_depth, scale_of_gps
from perception.geometry import camera_centres, transform
from perception.photos.depth import load_depth
from perception.types import Scene, View

UNIT_IS_METRE, UNIT_OF_DEPTH = 0.03, 0.4
"""Largest deviation from 1, and largest standard error, at which a measured unit is taken as the metre as it is; the
largest one, by depth images, from the metre that the input states at which those are used as they are."""
SAMPLED = 200  # views whose depth images are read for the planes that show gravity
STATED = {"metres_per_unit": 1.0, "source": "the input, which states it", "standard_error": None}


def in_world_frame(scene: Scene, options: FrameConfig, seed: int = 0) -> Scene:
    """The scene in the map's frame, recorded in report["scale"], ["gravity"] and ["map_from_input"].

    A scene whose input has poses keeps its world unless `options.keep_world` is False: only the unit becomes the metre
    when `options` give a known size. Photos without poses get the map's frame as far as it is known: turned if the
    standard error of gravity allows (`Gravity.confident`), in metres if a scale is measured. InputError for a
    known size that is not seen.
    """
    posed = scene.report.get("input") != "photos"
    size_given = any((options.known_length, options.tag_size, options.board))
    metric, scale, notes = _unit(scene, options, posed, seed)
    facts = {"scale": scale.to_json()} if scale is not None else {"scale": STATED} if metric else {}
    report = {**scene.report, **facts, "warnings": [*scene.report.get("warnings", []), *notes]}
    scene = _depth_in_units(replace(scene, metric=metric, report=report), scale, posed)
    gravity, notes = _gravity(scene, seed)
    scene.report["warnings"] += notes
    if gravity is not None:
        scene.report["gravity"] = gravity.to_json()
    keep = posed if options.keep_world is None else options.keep_world
    unit = 1.0 if metric or scale is None else scale.metres
    if keep and not (posed and size_given and options.keep_world is None):
        return scene
    if gravity is None or not gravity.confident or keep:
        map_from_world = np.diag([unit, unit, unit, 1.0])
    else:
        map_from_world = upright(scene.views[0].camera_from_world, _real_points(scene), gravity, unit)
    if scale is not None and not metric:
        measured = Measurement(1.0, scale.standard_error / scale.metres, scale.source)
        scene = replace(scene, metric=True, report={**scene.report, "scale": measured.to_json()})
    if not np.array_equal(map_from_world, np.eye(4)):
        scene = moved_scene(scene, map_from_world)
    if not posed:
        scene.report.pop("map_from_input", None)  # no input has the arbitrary frame of structure from motion
    return scene


def measured_scale(
    views: Sequence[View], points: np.ndarray, options: FrameConfig, seed: int = 0
) -> tuple[Measurement | None, list[str]]:
    """Metres per unit from all sources that posed views offer, and notes. InputError as `in_world_frame`."""
    gps, notes = scale_of_gps(views, seed)
    found = [scale_of_depth(views, points, seed), gps]
    length, board = references(options)
    if length is not None:
        found.append(scale_of_pixels(views, length))
    if options.tag_size is not None:
        found.append(scale_of_tags(views, options.tag_size))
    if board is not None:
        found.append(scale_of_board(views, board))
    scale, warnings = combined([each for each in found if each is not None])
    return scale, [*notes, *warnings]


def references(options: FrameConfig) -> tuple[KnownLength | None, Board | None]:
    """The length in photos and the board that the settings name. InputError for what cannot be read, or is no length in
    photos."""
    length = None if options.known_length is None else known_length(options.known_length)
    if length is not None and length.pixels is None:
        what = "before the map exists it is given by pixels of photos, 'METRES: PHOTO X,Y X,Y; PHOTO X,Y X,Y'"
        raise InputError(f"known length: {what}; by instances or points of a finished map with `perception scale`")
    return length, None if options.board is None else Board.from_text(options.board)


def _unit(scene: Scene, options: FrameConfig, posed: bool, seed: int) -> tuple[bool, Measurement | None, list[str]]:
    """Whether the unit is the metre, its measurement, notes."""
    scale, notes = measured_scale(scene.views, _real_points(scene), options, seed)
    if scale is None:
        return scene.metric, None, notes
    off, error = abs(np.log(scale.metres)), scale.standard_error / scale.metres
    if scene.metric:
        if off > 3 * error + UNIT_IS_METRE:
            notes.append(f"the input states that its unit is the metre, but it is {scale}")
        return True, scale, notes
    return posed and bool(max(off, error) <= UNIT_IS_METRE), scale, notes


def _gravity(scene: Scene, seed: int) -> tuple[Gravity | None, list[str]]:
    """The input's gravity or that of the scene, whichever is more certain, and notes. The scene's sign is that of the
    cameras, which robots also mount upside down, so the input's is taken where both are opposite."""
    measured = _measured_points(scene.views)
    points = measured if len(measured) else _real_points(scene)
    found = gravity_of_scene(np.stack([view.camera_from_world for view in scene.views]), points, seed)
    if "gravity" not in scene.report:
        return found, []
    given = Gravity.from_json(scene.report["gravity"])
    if found is None:
        return given, []
    angle = float(np.degrees(np.arccos(np.clip(given.direction @ found.direction, -1, 1))))
    notes = []
    if angle > 3 * np.hypot(given.standard_error, found.standard_error) + 2:
        notes.append(f"the input's gravity and that of the scene ({found.source}) differ by {angle:.0f}°")
    return given if given.standard_error <= found.standard_error or angle > 90 else found, notes


def _measured_points(views: Sequence[View]) -> np.ndarray:
    """[P, 3] in the world: what depth images of at most SAMPLED views measured, thinned to 2 % of the median depth."""
    found = [np.empty((0, 4))]
    for view in views[:: -(-len(views) // SAMPLED)]:
        size = np.array([64, max(round(64 * view.height / view.width), 1)])
        z = load_depth(view, *size)
        row, column = np.nonzero(z)
        pixels = (np.stack([column, row], axis=1) + 0.5) / size * [view.width, view.height]
        z = z[row, column, None]
        own = np.c_[(pixels - view.K[:2, 2]) / np.diag(view.K)[:2], np.ones(len(z))] * z
        found.append(np.c_[(own - view.camera_from_world[:3, 3]) @ view.camera_from_world[:3, :3], z])
    points, depth = np.split(np.concatenate(found), [3], axis=1)
    cells = np.floor(points / (0.02 * np.median(depth))) if len(points) else points
    return points[np.sort(np.unique(cells, axis=0, return_index=True)[1])]


def _real_points(scene: Scene) -> np.ndarray:
    return scene.points[:0] if scene.report.get("points_from") == "random" else scene.points


def _depth_in_units(scene: Scene, scale: Measurement | None, posed: bool) -> Scene:
    """The scene with depth images in its own unit, where sensor and poses measure in different units."""
    if scale is None or not any(view.depth for view in scene.views):
        return scene
    near = 3 * scale.standard_error / scale.metres + (UNIT_OF_DEPTH if scene.metric else UNIT_IS_METRE)
    if (posed and abs(np.log(scale.metres)) <= near) or (scene.metric and "depth" not in scale.source):
        return scene
    views = [
        view if view.depth is None else replace(view, depth=replace(view.depth, scale=view.depth.scale / scale.metres))
        for view in scene.views
    ]
    if posed:
        scene.report["warnings"].append(f"depth images are converted to the unit of the poses: {scale}")
    return replace(scene, views=views)


def upright(pose: np.ndarray, points: np.ndarray, gravity: Gravity, unit: float) -> np.ndarray:
    """map_from_world [4, 4]: z up, x along the view of the first camera, the origin on the floor below it.
    pose [4, 4]: camera_from_world of that camera. points [P, 3]: of the scene. unit: metres per unit of the world."""
    up = -gravity.direction
    eye, ahead = camera_centres(pose[None])[0], pose[2, :3] - (pose[2, :3] @ up) * up
    if np.linalg.norm(ahead) < 0.3:  # it looks down or up: what is up in its photo lies ahead
        ahead = ((pose[1, :3] @ up) * up - pose[1, :3]) * np.sign(pose[2, :3] @ -up)
    x = ahead / np.linalg.norm(ahead)
    axes = np.stack([x, np.cross(up, x), up])
    origin = eye + (floor_height(up, points, eye) - eye @ up) * up
    return transform(unit * axes, -unit * axes @ origin)
