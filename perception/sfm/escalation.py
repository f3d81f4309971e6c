"""More effort for photos that structure from motion leaves out at once.

A step counts only if it registers more photos, is not folded, and agrees with at least as many matches as before.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from perception.geometry import align_similarity
from perception.io.atomic import atomic_directory, recover
from perception.photos.lens import load_pycolmap
from perception.sfm import incremental, merge
from perception.sfm.alternatives import settled
from perception.sfm.appearance import likeness, looks_better
from perception.sfm.consistency import consistent_photos, fold_warnings, stronger_contradictions, verified_pairs
from perception.sfm.database import FeatureStore, delete_pairs, verified_matches
from perception.sfm.feature_tasks import write_part
from perception.sfm.features import FEW_FEATURES, THOROUGH, Group, extract, match
from perception.sfm.incremental import MIN_MODEL_SIZE, map_photos, pipeline_options, take_out
from perception.sfm.options import ReadOptions
from perception.sfm.pairs import largest_features, similar_photos

MORE = "more"
"""Folder in that of the features at once."""
ALL_PAIRS = 150
"""Of up to so many photos, those left out are matched with all others; of more, with the most similar."""
DOUBT = 4
"""Photos are not added if over 1/DOUBT of the matched pairs between them and the others contradict their poses."""
MOVED = 0.05
"""Nor if this moves the photos registered before, in the median and relative to their mean distance from the centre."""
SHARED, PARTNERS, EACH = 30, 3, 10
"""Least number of points that a photo shares with two others: points of two photos alone leave a chain's scale open.
Least number of photos with EACH of which it shares so many points. Right photos shared 43 and had 3 such photos, wrong
ones at the end of a chain shared 25 and 40, and one had 2."""
CANDIDATES = 4
"""Models mapped anew of which the best is used; two from all pairs, two from the stronger ones."""
HELD = 0.5, 0.2
"""Shares of the matches of a pair, tried in turn, from which on it holds a photo where it is; by chance 0.13 agree."""


@dataclass(frozen=True)
class Candidate:
    """Models of the features of `store`, largest first, and the names of photos left out as contradicting the first."""

    models: list[Any]
    contradicted: set[str]
    store: FeatureStore

    @cached_property
    def registered(self) -> frozenset[int]:
        """Image ids of the photos of the largest model."""
        return frozenset(self.models[0].reg_image_ids() if self.models else ())

    @property
    def folded(self) -> bool:
        """Whether the largest model may be folded."""
        return bool(self.models) and bool(fold_warnings(self.models[0], self.store.database))

    @property
    def support(self) -> int:
        """Verified matches of the pairs that agree with the largest model, less those of the pairs that contradict."""
        pairs = verified_pairs(self.models[0], self.store.database) if self.models else []
        return sum(pair.inliers if pair.agrees else -pair.inliers for pair in pairs)


@dataclass
class Escalation:
    """best: the candidate so far. groups: the photos of each camera (see `features`). more: THOROUGH features. known:
    models of these. rival: the best, with the points of `more`."""

    best: Candidate
    groups: list[Group]
    options: ReadOptions
    more: FeatureStore | None = None
    known: list[Any] = field(default_factory=list)
    rival: Candidate | None = None
    trusted: bool = False
    """Whether half of the photos are in the models at once, and the matches of `more` contradict none of these."""

    def run(self) -> tuple[Candidate, list[dict[str, Any]]]:
        """The best candidate; of each step its name, the photos registered after it, and seconds."""
        names, few = self.best.store.names, len(self.best.store.names) <= incremental.REPEATABLE_PHOTOS
        steps: list[dict[str, Any]] = [{"step": "at once", "registered": len(self.best.registered)}]
        tries = {"more features": self._grow}
        tries |= {"mapping anew": self._anew, "comparing photos": self._compare} if few else {}
        tries |= {"joining models": self._join}
        tries |= {"global mapping": self._global} if few else {}
        for name, attempt in tries.items():
            registered, started = len(self.best.registered), time.perf_counter()
            if registered == len(names) or not (self._linked(self.more) if self.more else self._left_out()):
                break
            self.options.progress.log(f"poses: {registered} of {len(names)} photos registered; {name} is next")
            self.more = self.more or self._more_features()
            found = attempt(self.more)
            if found is not None and self._is_better(found):
                self.best, self.rival, self.more = found, found, found.store
            spent = time.perf_counter() - started
            steps.append({"step": name, "registered": len(self.best.registered), "seconds": spent})
        return self.best, steps

    def _is_better(self, found: Candidate) -> bool:
        more = len(found.registered) - len(self.best.registered)
        if found.folded or self.best.folded:
            return more >= 0 and not found.folded
        agrees = found.support >= (self.rival.support if self.rival else 0)
        return more > 0 and agrees and not (self.trusted and self._doubtful(found))

    def _doubtful(self, found: Candidate) -> bool:
        """Whether photos of the best lie elsewhere, or many pairs of one of them and a new one contradict the model."""
        both = sorted(self.best.registered & found.registered)
        if len(both) < MIN_MODEL_SIZE:
            return True
        had, now = (np.stack([c.models[0].images[i].projection_center() for i in both]) for c in (self.best, found))
        scale, turn, shift = align_similarity(had, now)
        moved = np.linalg.norm(scale * now @ turn.T + shift - had, axis=1)
        if np.median(moved) > MOVED * np.linalg.norm(had - had.mean(axis=0), axis=1).mean():
            return True
        pairs = verified_pairs(found.models[0], found.store.database)
        across = [pair.agrees for pair in pairs if len({pair.i, pair.j} & self.best.registered) == 1]
        return across.count(False) * DOUBT > len(across)

    def _left_out(self) -> list[int]:
        """Rows of the photos that are not registered and have enough features to be."""
        store, done = self.best.store, set() if self.best.folded else self.best.registered
        with load_pycolmap().Database.open(store.database) as db:
            ids = [db.read_image_with_name(name).image_id for name in store.names]
            enough = [db.num_keypoints_for_image(image) >= FEW_FEATURES for image in ids]
        return [row for row, image in enumerate(ids) if enough[row] and image not in done]

    def _linked(self, store: FeatureStore) -> bool:
        """Whether photos that are not in one model have verified matches."""
        done, verified = [set(model.reg_image_ids()) for model in self.best.models], verified_matches(store.database)
        return any(len(found) and not any(each >= set(pair) for each in done) for pair, found in verified.items())

    # ------------------------------------------------------------------ steps

    def _grow(self, store: FeatureStore) -> Candidate | None:
        """The models so far, with the points of more features, and photos added."""
        if self.best.folded or not self.best.models:
            return None
        start = self._adjusted(self.best.models[:1], store)
        self.rival = Candidate([load_pycolmap().Reconstruction(start)], set(), store)
        many = 2 * len(self.best.registered) >= len(store.names)
        self.trusted = many and consistent_photos(verified_pairs(start, store.database)) == self.best.registered
        grown = [self._grown(start, store)]
        grown += [self._grown(self._adjusted([model], store), store) for model in self.best.models[1:]]
        return max(grown, key=lambda each: len(each.registered))

    def _anew(self, store: FeatureStore) -> Candidate | None:
        found: list[Candidate] = []
        for models, out in incremental.candidates(store, self._pipeline(store), self.options.progress, CANDIDATES):
            whole = load_pycolmap().Reconstruction(models[0])
            found.append(self._checked(models, out, store))
            if len(found[-1].registered) >= whole.num_reg_images() and not found[-1].folded:
                break
            found += self._parts_joined(whole, store)
            if len(found[-1].registered) == len(store.names) and not found[-1].folded:
                break
        if not found:
            return None
        best = _best(found)
        for kept in sorted({each.registered for each in found if each.registered < best.registered}, key=sorted):
            if moved := self._moved(best, kept, store):
                return _best([*found, moved])
        return best

    def _moved(self, found: Candidate, kept: frozenset[int], store: FeatureStore) -> Candidate | None:
        """A candidate with the photos that are not `kept` where the pairs put them that contradict `found`, if photos
        look clearly more alike then. The pairs that held them in `found` are wrong and deleted, so as not to count."""
        whole, taken = found.models[0], found.registered - kept
        pairs = [pair for pair in verified_pairs(whole, store.database) if len({pair.i, pair.j} & taken) == 1]
        for share in HELD if len(kept) >= MIN_MODEL_SIZE else ():
            held = {(pair.i, pair.j) for pair in pairs if pair.share >= share}
            with TemporaryDirectory(dir=store.folder) as folder:
                less = replace(store, folder=Path(folder))
                shutil.copyfile(store.database, less.database)
                delete_pairs(less.database, held)
                start = self._adjusted([merge.part_of(whole, set(kept))], less)
                model = self._adjusted(self._mapped(start, less)[0][:1], less)
            moved = set(taken & set(model.reg_image_ids()))
            others = set(model.reg_image_ids()) & found.registered - moved
            if moved and looks_better(*(likeness(each, store.image_root, moved, others) for each in (model, whole))):
                right = {(pair.i, pair.j) for pair in verified_pairs(model, store.database) if pair.agrees}
                delete_pairs(store.database, {pair for pair in held - right if moved & set(pair)})
                return self._checked([model], found.contradicted, store)
        return None

    def _parts_joined(self, model: Any, store: FeatureStore) -> list[Candidate]:
        """One model of the two parts that matches divide in a folded one: these matches say where the second lies.
        Without it 23 of 31 photos of a tabletop are registered, and 14 of 21."""
        pairs, matches = verified_pairs(model, store.database), verified_matches(store.database)
        if not stronger_contradictions(pairs):
            return []
        first = consistent_photos(pairs)
        second = consistent_photos([pair for pair in pairs if not {pair.i, pair.j} & first])
        against = {(pair.i, pair.j): matches[pair.i, pair.j] for pair in pairs if not pair.agrees}
        main, other = merge.part_of(model, first), merge.part_of(model, second)
        if len(second) < MIN_MODEL_SIZE or not merge.align_by_matches(main, other, against, self.options.seed):
            return []
        return [self._grown(self._adjusted([main, other], store), store, joined=True)]

    def _compare(self, store: FeatureStore) -> Candidate | None:
        """The best model, if it has half of the photos, with others added where they look right, and without the pairs
        that put one elsewhere."""
        if self.best.folded or 2 * len(self.best.registered) < len(store.names):
            return None
        less, wrong, known = self._copied(store, "compared"), set[tuple[int, int]](), -1
        model = self._adjusted(self.best.models[:1], less)
        while len(wrong) > known:
            known = len(wrong)
            while (found := settled(model, store, wrong, self.options.seed))[1] - wrong:
                wrong |= found[1]
                delete_pairs(less.database, found[1])
                kept = merge.part_of(model, set(model.reg_image_ids()) - set(found[0].reg_image_ids()))
                model = self._adjusted([kept, found[0]], less)
            if wrong:
                model = self._mapped(model, less)[0][0]
        return self._grown(model, less) if wrong else None

    def _join(self, store: FeatureStore) -> Candidate | None:
        """One model of those that share photos."""
        groups = merge.align(merge.without_repeats([self.known]), self.options.seed)
        return self._grown(self._adjusted(groups[0], store), store) if groups and len(groups[0]) > 1 else None

    def _global(self, store: FeatureStore) -> Candidate | None:
        pycolmap = load_pycolmap()
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed, options.num_threads = self.options.seed, 1
        options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
        with TemporaryDirectory(dir=store.folder) as out:
            found = pycolmap.global_mapping(store.database, store.image_root, out, options).values()
        largest = max(found, key=lambda model: model.num_reg_images(), default=None)
        return self._grown(self._adjusted([largest], store), store) if largest is not None else None

    # ----------------------------------------------------------------- models

    def _pipeline(self, store: FeatureStore) -> Any:
        """The options of pycolmap for the features of the store."""
        return pipeline_options(self.options.lens is not None, self.options.seed, True, store.effort)

    def _adjusted(self, models: list[Any], store: FeatureStore) -> Any:
        """One model of aligned ones, adjusted to all matches of the store."""
        return merge.adjusted(merge.merged(models), store, self._pipeline(store), add=False)

    def _grown(self, start: Any, store: FeatureStore, again: bool = True, joined: bool = False) -> Candidate:
        """`start` with photos added, checked."""
        return self._checked(*self._mapped(start, store), store, again, joined)

    def _mapped(self, start: Any, store: FeatureStore) -> incremental.Mapped:
        """`start` with photos added."""
        return map_photos(store, self._pipeline(store), len(store.names), self.options.progress, start)

    def _checked(
        self, models: list[Any], contradicted: set[str], store: FeatureStore, again: bool = True, joined: bool = False
    ) -> Candidate:
        """Without photos that matches contradict or few others hold; where there are such, the rest is adjusted anew.
        again: then photos are added once more, as the wrong ones may have been in the way. joined: of two parts."""
        best, complete = models[0], models[0].num_reg_images()
        while (wrong := _contradicted(best, store, joined)) | (loose := _loose(best)):
            contradicted = contradicted | {best.images[image].name for image in wrong}
            take_out(best, wrong | loose)
            if best.num_reg_images() < MIN_MODEL_SIZE:
                return Candidate([], contradicted, store)
            best = self._adjusted([best], store)
        self.known += [best, *models[1:]]
        had, largest = set(best.reg_image_ids()), best.num_reg_images()
        others = [model for model in models[1:] if model.num_reg_images() <= largest]
        others = [model for model in others if len(set(model.reg_image_ids()) - had) >= MIN_MODEL_SIZE]
        kept = Candidate([best, *others], contradicted, store)
        if not again or largest == complete:
            return kept
        grown = self._grown(self._adjusted([best], store), store, again=False, joined=joined)
        return grown if grown.registered > kept.registered and grown.support > kept.support else kept

    # --------------------------------------------------------------- features

    def _more_features(self) -> FeatureStore:
        """THOROUGH features of the photos left out and of those similar to them; those left out are matched with all
        others, and every verified pair of photos with new features again."""
        store, progress = self.best.store, self.options.progress
        names, folder = store.names, store.folder / MORE
        recover(folder)
        if not folder.is_dir():
            with load_pycolmap().Database.open(store.database) as db:
                ids = [db.read_image_with_name(name).image_id for name in names]
            left = self._left_out()
            similar = similar_photos(largest_features(store.database, names))
            again = np.zeros(len(names), bool)
            for i in left:
                again[similar[i]] = True
            row = {image: n for n, image in enumerate(ids)}
            pairs = {(row[i], row[j]) for (i, j), found in verified_matches(store.database).items() if len(found)}
            pairs = {pair for pair in pairs if again[list(pair)].any()}
            possible = similar if len(names) > ALL_PAIRS else [np.arange(len(names))] * len(names)
            pairs |= {(i, j) for i in left for j in possible[i].tolist() if i != j}
            chosen = sorted({(min(pair), max(pair)) for pair in pairs})
            with atomic_directory(folder) as new:
                database, kept = new / store.database.name, [image for image, n in row.items() if not again[n]]
                write_part(store.database, kept, database, matched=True)
                wanted = {name for name, n in zip(names, again, strict=True) if n}
                groups = [([name for name in group if name in wanted], reader) for group, reader in self.groups]
                extract(database, store.image_root, [each for each in groups if each[0]], progress, THOROUGH)
                match(database, [(names[i], names[j]) for i, j in chosen], self.options.seed, progress, THOROUGH)
        facts = {**store.facts, "pairs_matched": len(verified_matches(folder / store.database.name))}
        made = FeatureStore(folder, store.image_root, names, facts, THOROUGH)
        return self._copied(made, "work")  # pairs are deleted from a copy: an interrupted call begins with all

    def _copied(self, store: FeatureStore, name: str) -> FeatureStore:
        folder = store.folder / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        shutil.copyfile(store.database, folder / store.database.name)
        return replace(store, folder=folder)


def _best(found: list[Candidate]) -> Candidate:
    return max(found, key=lambda each: (not each.folded, each.support))


def _contradicted(model: Any, store: FeatureStore, joined: bool) -> set[int]:
    """Photos of a model that the matches of others contradict. joined: of its two parts, none if no contradicted pair
    is stronger than those it rests on, as where textures are equal, right models contradict many."""
    pairs = verified_pairs(model, store.database)
    if joined and not stronger_contradictions(pairs):
        return set()
    return set(model.reg_image_ids()) - consistent_photos(pairs)


def _loose(model: Any) -> set[int]:
    """Photos of a model that share less than SHARED points with two others, or too few with a third."""
    tracks = [sorted({each.image_id for each in point.track.elements}) for point in model.points3D.values()]
    shared = Counter(image for track in tracks if len(track) > 2 for image in track)
    common = Counter(pair for track in tracks for pair in permutations(track, 2))
    partners = Counter(image for (image, _), count in common.items() if count >= EACH)
    least = min(PARTNERS, model.num_reg_images() - 1)
    return {image for image in model.reg_image_ids() if shared[image] < SHARED or partners[image] < least}
