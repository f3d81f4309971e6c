"""Structure from motion of many photos, place by place.

The photos are divided where few of them match; each place is mapped by one thread, in a frame of its own, as a task of
the engine. Places next to each other share some photos, by which their models are welded; then one bundle adjustment
goes over all. So time grows little faster than the number of photos, and the result is repeatable.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import networkx as nx
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import eigsh

from perception.errors import InputError
from perception.io.atomic import atomic_directory
from perception.photos.lens import load_pycolmap
from perception.progress import Progress
from perception.sfm.feature_tasks import write_part
from perception.sfm.features import FeatureStore, verified_matches
from perception.sfm.incremental import (
    MIN_MODEL_SIZE,
    Found,
    is_contradicted,
    map_photos,
    outvoted_photos,
    pipeline_options,
    take_out,
    verified_pairs,
)
from perception.tasks.engine import Engine
from perception.tasks.folder import has_task, read_facts, write_task

LARGEST, BORDER = 100, 15
"""Photos of a place at most, and photos that each place next to it adds."""
SIDE = 0.25
"""Least share of the photos on either side of a cut."""
SHARED = 3
"""Least number of photos by which two models are joined."""
TOLERANCE, DIRECT = 1e-6, 20_000
"""Of the last bundle adjustment: the relative gain at which it ends (the distance between rooms is known by few photos,
so 1e-5 is too early), and photos up to which its normal equations are solved by factorisation, which is then faster."""
RESULT = "result"

Matches = dict[tuple[int, int], int]
"""Number of verified matches of each pair of image ids."""


def map_places(store: FeatureStore, fixed: bool, seed: int, engine: Engine, progress: Progress) -> Found | None:
    """As `map_photos`, place by place; None where the photos' matches contradict the welded model."""
    counts = {pair: len(found) for pair, found in verified_matches(store.database).items() if len(found)}
    if not counts:
        return None
    places = with_border(divide(counts, LARGEST), counts)
    homes = [_task(store, photos, number, fixed, seed) for number, photos in enumerate(places)]
    engine.run(place_task, [str(home.resolve()) for home in homes], "poses: place", progress, each_core=True)
    groups = weld(needed([part for home in homes for part in _parts(home)]), seed)
    if not groups:
        return None
    progress.update("poses: adjusting", 0, 1)
    best, *others = map(_joined, groups)
    best = _adjusted(best, store, pipeline_options(fixed, seed, one_thread=True))
    pairs = verified_pairs(best, store.database)
    progress.update("poses: adjusting", 1, 1)
    if is_contradicted(pairs):
        progress.log("poses: matches contradict the model welded from places; all photos are mapped in one piece")
        return None
    wrong = outvoted_photos(pairs)
    left_out = {best.images[image].name for image in wrong}
    had = set(best.reg_image_ids())  # photos of the others may have been added
    others = [model for model in others if len(set(model.reg_image_ids()) - had) >= MIN_MODEL_SIZE]
    take_out(best, wrong)
    shutil.rmtree(store.folder / "places")
    return [best, *others], left_out


# ----------------------------------------------------------------------- division


def divide(matches: Matches, most: int) -> list[list[int]]:
    """Image ids of the photos of each place, at most `most`, together all photos with matches.

    Connected photos are cut in two, again and again, where the normalised cut is least (Shi and Malik, "Normalized cuts
    and image segmentation", PAMI 2000) among the cuts along the second eigenvector, with SIDE of the photos on either
    side at least.
    """
    ids = sorted({image for pair in matches for image in pair})
    row = {image: n for n, image in enumerate(ids)}
    pairs = np.array([(row[i], row[j]) for i, j in matches]).reshape(-1, 2)
    half = sparse.coo_matrix((np.array(list(matches.values()), float), pairs.T), shape=(len(ids), len(ids)))
    weights = sparse.csr_matrix(half + half.T)
    label = sparse.csgraph.connected_components(weights, directed=False)[1]
    parts = [np.flatnonzero(label == n) for n in range(label.max() + 1)]
    done = []
    while parts:
        part = parts.pop(0)
        if len(part) <= most:
            done.append([ids[n] for n in part.tolist()])
        else:
            above = _upper_half(weights[part][:, part])
            parts += [part[~above], part[above]]
    return sorted(done)


def _upper_half(weights: sparse.csr_matrix) -> np.ndarray:
    """[n] bool of symmetric weights [n, n]."""
    count = weights.shape[0]
    degree = np.asarray(weights.sum(axis=1)).ravel()
    scaled = sparse.diags(degree**-0.5)
    start = np.random.default_rng(0).normal(size=count)  # ARPACK's own is random
    vector = eigsh(scaled @ weights @ scaled, k=2, which="LA", v0=start)[1][:, 0] * degree**-0.5
    order = np.argsort(vector, kind="stable")
    rank = np.argsort(order, kind="stable")
    upper = sparse.triu(weights).tocoo()
    ends = np.sort([rank[upper.row], rank[upper.col]], axis=0)
    # crossing[k]: weight of the pairs between the first k photos in this order and the others
    begun, ended = (np.bincount(end + 1, upper.data, count + 1) for end in ends)
    crossing = np.cumsum(begun - ended)
    volume = np.concatenate([[0], np.cumsum(degree[order])])
    least = max(1, int(SIDE * count))
    cuts = np.arange(least, count - least + 1)
    cost = crossing[cuts] * (1 / volume[cuts] + 1 / (volume[-1] - volume[cuts]))
    return np.asarray(rank >= cuts[cost.argmin()])


def with_border(places: list[list[int]], matches: Matches) -> list[list[int]]:
    """The photos of each place, and those of the places next to it that lead into them.

    Next to each other are the neighbours in the maximum spanning tree by the strongest pair of photos of two places:
    places that only look alike are not.
    """
    of = {image: n for n, place in enumerate(places) for image in place}
    linked: dict[int, dict[int, int]] = {image: {} for image in of}
    graph = nx.Graph()
    graph.add_nodes_from(range(len(places)))
    for (i, j), found in sorted(matches.items()):
        linked[i][j] = linked[j][i] = found
        if of[i] != of[j] and found > graph.get_edge_data(of[i], of[j], {"weight": 0})["weight"]:
            graph.add_edge(of[i], of[j], weight=found)
    tree = nx.maximum_spanning_tree(graph)
    return [
        sorted([*place, *(image for other in tree[n] for image in _leading(place, set(places[other]), linked))])
        for n, place in enumerate(places)
    ]


def _leading(place: list[int], other: set[int], linked: dict[int, dict[int, int]]) -> list[int]:
    """BORDER photos of `other`, each the one with the strongest pair with `place` or those before it."""
    waiting = [(-found, image) for known in place for image, found in linked[known].items() if image in other]
    chosen: list[int] = []
    heapify(waiting)
    while waiting and len(chosen) < BORDER:
        image = heappop(waiting)[1]
        if image not in chosen:
            chosen.append(image)
            for new, found in linked[image].items():
                if new in other:
                    heappush(waiting, (-found, new))
    return chosen


# ----------------------------------------------------------------------- tasks


def _task(store: FeatureStore, photos: list[int], number: int, fixed: bool, seed: int) -> Path:
    home = store.folder / "places" / str(number)
    if not has_task(home):
        home.mkdir(parents=True, exist_ok=True)
        write_part(store.database, photos, home / store.database.name, ("keypoints",), matched=True)
        write_task(home, count=len(photos), fixed=fixed, seed=seed, photos=str(store.image_root.resolve()))
    return home


def place_task(folder: str, progress: Progress | None = None) -> None:
    """Maps the place whose task lies in `folder`, and writes its models to RESULT there."""
    home = Path(folder)
    facts = read_facts(home)
    if (home / RESULT).is_dir():
        return
    store = FeatureStore(home, [], {}, Path(facts["photos"]))
    told = progress or Progress(quiet=True)
    models, _ = map_photos(store, facts["fixed"], facts["seed"], facts["count"], told, one_thread=True)
    with atomic_directory(home / RESULT) as new:
        for number, model in enumerate(models):
            (new / str(number)).mkdir()
            model.write(new / str(number))


def _parts(home: Path) -> list[Any]:
    """The models of a place, each in a frame of its own."""
    if not (home / RESULT).is_dir():
        raise InputError(f"{home}: has no {RESULT} after its task; workers must share the output's folder")
    return [load_pycolmap().Reconstruction(folder) for folder in sorted((home / RESULT).iterdir())]


# ----------------------------------------------------------------------- welding


def needed(parts: Sequence[Any]) -> list[Any]:
    """The models, largest first, with at least MIN_MODEL_SIZE photos that no larger one has. Small ones that repeat
    photos of others are what did not fit into their place."""
    found, had = [], set[int]()
    for part in sorted(parts, key=lambda part: (-part.num_reg_images(), sorted(part.reg_image_ids()))):
        if len(new := set(part.reg_image_ids()) - had) >= MIN_MODEL_SIZE:
            found.append(part)
            had |= new
    return found


def weld(parts: Sequence[Any], seed: int) -> list[list[Any]]:
    """Groups of models that share photos, the largest group first; those of a group are moved into one frame.

    Models with most photos in common are joined first. A similarity moves one so that the points of either lie where
    the photos in both show them.
    """
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(seed)
    photos = [set(part.reg_image_ids()) for part in parts]
    joints = nx.Graph()
    joints.add_nodes_from(range(len(parts)))
    for a, b in combinations(range(len(parts)), 2):
        shared = len(photos[a] & photos[b])
        a_from_b = pycolmap.align_reconstructions_via_reprojections(parts[b], parts[a]) if shared >= SHARED else None
        if a_from_b is not None:
            joints.add_edge(a, b, weight=shared, transforms={b: a_from_b, a: a_from_b.inverse()})
    tree = nx.maximum_spanning_tree(joints)
    groups = []
    for group in nx.connected_components(tree):
        root = max(sorted(group), key=lambda n: len(photos[n]))
        world_from = {root: pycolmap.Sim3d()}
        for known, new in nx.bfs_edges(tree, root):
            world_from[new] = world_from[known] * tree.edges[known, new]["transforms"][new]
            parts[new].transform(world_from[new])
        groups.append(sorted(group))
    groups.sort(key=lambda group: -len(set().union(*(photos[n] for n in group))))
    return [[parts[n] for n in group] for group in groups]


def _joined(parts: Sequence[Any]) -> Any:
    """One model of welded ones, without points. The pose of a photo is that of the model in which it has the most
    points; intrinsics are the medians of all."""
    pycolmap = load_pycolmap()
    best: dict[int, Any] = {}
    cameras: dict[int, list[Any]] = {}
    for part in parts:
        for image in sorted(part.reg_image_ids()):
            if image not in best or part.images[image].num_points3D > best[image].num_points3D:
                best[image] = part.images[image]
        for number, camera in part.cameras.items():
            cameras.setdefault(number, []).append(camera)
    model = pycolmap.Reconstruction()
    for number in sorted({image.camera_id for image in best.values()}):
        camera = cameras[number][0]
        camera.params = np.median([each.params for each in cameras[number]], axis=0)
        model.add_camera_with_trivial_rig(camera)
    for number, image in sorted(best.items()):
        plain = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=number)
        model.add_image_with_trivial_frame(plain, image.cam_from_world())
    return model


def _adjusted(model: Any, store: FeatureStore, options: Any) -> Any:
    """Points of all matches; then poses, points and intrinsics adjusted together, again where photos were missing."""
    pycolmap = load_pycolmap()
    with TemporaryDirectory(dir=store.folder) as out:
        model = pycolmap.triangulate_points(model, store.database, store.image_root, out, True, options)
    db = pycolmap.Database.open(store.database)
    cache = pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches))
    db.close()
    mapper, triangulation = pycolmap.IncrementalMapper(cache), options.get_triangulation()
    mapper.begin_reconstruction(model)
    adjustment = options.get_global_bundle_adjustment()
    adjustment.ceres.solver_options.function_tolerance = TOLERANCE
    adjustment.ceres.max_num_images_direct_sparse_cpu_solver = DIRECT
    limits = options.ba_global_max_refinements, options.ba_global_max_refinement_change
    mapper.iterative_global_refinement(*limits, options.get_mapper(), adjustment, triangulation)
    added = False
    # Photos that no place has: `any` ends at the first that is registered, after which others may be.
    while any(_register(mapper, image, options) for image in mapper.find_next_images(options.get_mapper(), False)):
        added = True
    if added:
        mapper.iterative_global_refinement(*limits, options.get_mapper(), adjustment, triangulation)
    mapper.end_reconstruction(False)
    model.extract_colors_for_all_images(store.image_root)
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
