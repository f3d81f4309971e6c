"""Merges overlapping submodels: moves them into one frame by the photos they share, then adjusts all together."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import combinations
from tempfile import TemporaryDirectory
from typing import Any

import networkx as nx
import numpy as np

from perception.photos.lens import load_pycolmap
from perception.sfm.alignment import robust_similarity
from perception.sfm.database import FeatureStore
from perception.sfm.incremental import MIN_MODEL_SIZE, take_out
from perception.sfm.partition import OVERLAP

Matches = dict[tuple[int, int], np.ndarray]

SHARED = 3
"""Least number of photos by which two models are joined."""
MATCHED, NEAR = 50, 0.02
"""Least number of matched points by which two parts are joined, and the distance at which they fit, relative to the
median distance of these points from their centre."""
TOLERANCE, DIRECT = 1e-6, 20_000
"""Of the last bundle adjustment: the relative gain at which it ends (the distance between rooms is known by few photos,
so 1e-5 is too early), and photos up to which its normal equations are solved by factorisation, which is then faster."""


def without_repeats(found: Sequence[Sequence[Any]]) -> list[Any]:
    """The models of submodels, `found` in each, largest first: the largest of each submodel, by which its neighbours
    may be joined, if it has more photos than a neighbour adds, and others with at least MIN_MODEL_SIZE photos that no
    larger one has. Small ones that repeat photos of others are what did not fit into their submodel."""
    kept, had = [], set[int]()
    largest = [max(models, key=_rank) for models in found if models]
    joins = {id(model) for model in largest if model.num_reg_images() > OVERLAP}
    for model in sorted((model for models in found for model in models), key=_rank, reverse=True):
        if id(model) in joins or len(set(model.reg_image_ids()) - had) >= MIN_MODEL_SIZE:
            kept.append(model)
            had |= set(model.reg_image_ids())
    return kept


def _rank(model: Any) -> tuple[int, list[int]]:
    """Orders models by their number of photos, equal ones by the ids of these, the first ones higher."""
    return model.num_reg_images(), [-image for image in sorted(model.reg_image_ids())]


def align(models: Sequence[Any], seed: int) -> list[list[Any]]:
    """Groups of models that share photos, the largest group first; those of a group are moved into one frame.
    Models with most photos in common are joined first. A similarity moves one so that the points of either lie where
    the photos in both show them."""
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(seed)
    photos = [set(each.reg_image_ids()) for each in models]
    overlaps = nx.Graph()
    overlaps.add_nodes_from(range(len(models)))
    for a, b in combinations(range(len(models)), 2):
        shared = len(photos[a] & photos[b])
        a_from_b = pycolmap.align_reconstructions_via_reprojections(models[b], models[a]) if shared >= SHARED else None
        if a_from_b is not None:
            overlaps.add_edge(a, b, weight=shared, transforms={b: a_from_b, a: a_from_b.inverse()})
    tree = nx.maximum_spanning_tree(overlaps)
    groups = []
    for group in nx.connected_components(tree):
        root = max(sorted(group), key=lambda n: len(photos[n]))
        world_from = {root: pycolmap.Sim3d()}
        for known, new in nx.bfs_edges(tree, root):
            world_from[new] = world_from[known] * tree.edges[known, new]["transforms"][new]
            models[new].transform(world_from[new])
        groups.append(sorted(group))
    groups.sort(key=lambda group: -len(set().union(*(photos[n] for n in group))))
    return [[models[n] for n in group] for group in groups]


def part_of(model: Any, photos: set[int]) -> Any:
    """A copy of a model with only these photos and what they see."""
    part = load_pycolmap().Reconstruction(model)
    take_out(part, set(model.reg_image_ids()) - photos)
    return part


def align_by_matches(main: Any, other: Any, matches: Matches, seed: int) -> bool:
    """Moves `other` so that most of its matched points lie on those of `main`; False where few do.
    matches: verified ones [M, 2] of pairs of image ids. Points are of tracks, so one match of two tracks is enough."""
    linked = dict[tuple[int, int], None]()
    for pair, found in matches.items():
        for side in (0, 1):
            if pair[side] in main.reg_image_ids() and pair[1 - side] in other.reg_image_ids():
                one, two = main.images[pair[side]].points2D, other.images[pair[1 - side]].points2D
                ends = ((one[int(m[side])], two[int(m[1 - side])]) for m in found)
                linked |= {(a.point3D_id, b.point3D_id): None for a, b in ends if a.has_point3D() and b.has_point3D()}
    if len(linked) < MATCHED:
        return False
    here = np.array([main.points3D[a].xyz for a, _ in linked])
    there = np.array([other.points3D[b].xyz for _, b in linked])
    near = NEAR * float(np.median(np.linalg.norm(here - np.median(here, axis=0), axis=1)))
    similarity = robust_similarity(there, here, near, seed)
    if similarity is None or similarity["num_inliers"] < MATCHED:
        return False
    other.transform(similarity["tgt_from_src"])
    return True


def merged(models: Sequence[Any]) -> Any:
    """One model of aligned ones, without points. The pose of a photo is that of the model in which it has the most
    points; intrinsics are the medians of all."""
    pycolmap = load_pycolmap()
    best: dict[int, Any] = {}
    cameras: dict[int, list[Any]] = {}
    for each in models:
        for image in sorted(each.reg_image_ids()):
            if image not in best or each.images[image].num_points3D > best[image].num_points3D:
                best[image] = each.images[image]
        for number, camera in each.cameras.items():
            cameras.setdefault(number, []).append(camera)
    model = pycolmap.Reconstruction()
    for number in sorted({image.camera_id for image in best.values()}):
        camera = copy(cameras[number][0])
        camera.params = np.median([one.params for one in cameras[number]], axis=0)
        model.add_camera_with_trivial_rig(camera)
    for number, image in sorted(best.items()):
        plain = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=number)
        model.add_image_with_trivial_frame(plain, image.cam_from_world())
    return model


def adjusted(model: Any, store: FeatureStore, options: Any, add: bool = True) -> Any:
    """Points of all matches; then poses, points and intrinsics adjusted together, again where photos were missing; and
    the points' colours. add: photos that are missing are added."""
    model = refined(triangulated(model, store, options), store, options, add)
    model.extract_colors_for_all_images(store.image_root)
    return model


def triangulated(model: Any, store: FeatureStore, options: Any) -> Any:
    """The model with points of all matches, at its poses."""
    with TemporaryDirectory(dir=store.folder) as out:
        return load_pycolmap().triangulate_points(model, store.database, store.image_root, out, True, options)


def refined(model: Any, store: FeatureStore, options: Any, add: bool) -> Any:
    """The model with poses, points and intrinsics adjusted. add: and photos that are missing."""
    pycolmap = load_pycolmap()
    wanted = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
    with pycolmap.Database.open(store.database) as db:
        cache = pycolmap.DatabaseCache.create(db, wanted)
    mapper, triangulation = pycolmap.IncrementalMapper(cache), options.get_triangulation()
    mapper.begin_reconstruction(model)
    adjustment = options.get_global_bundle_adjustment()
    adjustment.ceres.solver_options.function_tolerance = TOLERANCE
    adjustment.ceres.max_num_images_direct_sparse_cpu_solver = DIRECT
    limits = options.ba_global_max_refinements, options.ba_global_max_refinement_change
    mapper.iterative_global_refinement(*limits, options.get_mapper(), adjustment, triangulation)
    added = False
    # Photos that no submodel has: `any` ends at the first that is registered, after which others may be.
    while add and any(_register(mapper, i, options) for i in mapper.find_next_images(options.get_mapper(), False)):
        added = True
    if added:
        mapper.iterative_global_refinement(*limits, options.get_mapper(), adjustment, triangulation)
    mapper.end_reconstruction(False)
    return model


def _register(mapper: Any, image: int, options: Any) -> bool:
    """Adds a photo to the model, with its points, and adjusts its surroundings; False where no pose is found."""
    if not mapper.register_next_image(options.get_mapper(), image):
        return False
    triangulation = options.get_triangulation()
    mapper.triangulate_image(triangulation, image)
    limits = options.ba_local_max_refinements, options.ba_local_max_refinement_change
    local = options.get_local_bundle_adjustment()
    mapper.iterative_local_refinement(*limits, options.get_mapper(), local, triangulation, image)
    return True
