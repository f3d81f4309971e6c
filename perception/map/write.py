"""The map on disk (`name.gsmap/`): a standard 3DGS PLY, JSON facts, and arrays; docs/formats.md lists its files.

instances.json may hold `parts` of an instance: entries with the same keys and `parent`, the id of the whole. Ids of
parts follow those of the wholes. language.npz: see `language.description.to_arrays`.
parts.npz       ids [N] int32: the part each Gaussian belongs to (−1 = none; absent without parts). With an encoder also
                language_*: as language.npz, one row per part in ascending id
groups.npz      instances that may be one thing: of [I] int32, group of each instance in the order of instances.json,
                −1 = none; scores [G] float32; language_* as in parts.npz (absent without groups)
past.npz        where things stood at earlier visits (see `map.history`; absent without such things)
"""

from __future__ import annotations

import base64
import contextlib
import filecmp
import itertools
import json
import math
import shutil
from collections import defaultdict
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.io.documents import safe_name
from perception.io.ply import write_ply
from perception.map.checksums import EDITABLE, FACTS, IGNORED, REPORT, facts_of, listed_files, seal, verify
from perception.map.files import ARCHIVES, FORMAT_VERSION, MapFiles
from perception.map.map import Map
from perception.map.replace import map_directory, writing
from perception.photos.named_files import NamedFiles, folded, parts_of
from perception.photos.view_json import (
    StoredView,
    absolute,
    locate_photo,
    moved_record,
    stored_view,
    view_from_json,
    view_json,
)
from perception.types import View

LONGEST_LABEL = 200  # characters


def write_map(path: Path, gmap: Map, keep_report: bool = False, fresh: bool = False) -> None:
    """Writes the map to a temporary folder and exchanges it with `path`: readers see the old or the new map.

    Files in the old map's folder that no map wrote are kept. keep_report: keep the report of the replaced map, too, for
    manual corrections. fresh: nothing is replaced. A link at `path` stays, and its target is written.

    InputError when another writer holds the map, or `path` cannot be written, or holds something else than a map.

    >>> write_map(Path("copy.gsmap"), read_map(Path("kitchen.gsmap")))
    >>> len(read_map(Path("copy.gsmap")))
    3000
    """
    info = {**gmap.info, "format_version": FORMAT_VERSION, "num_gaussians": len(gmap)}
    info["num_instances"] = len(gmap.instances)
    info["sh_degree"] = math.isqrt(gmap.sh.shape[1]) - 1
    info["views"] = [view_json(_recorded(view, path, gmap.path)) for view in gmap.views]
    with writing(path), map_directory(path, fresh) as folder:
        write_gaussian_ply(folder / "gaussians.ply", gmap)
        np.save(folder / "features.npy", gmap.features.astype(np.float32))
        np.save(folder / "instance_ids.npy", gmap.instance_ids.astype(np.int32))
        np.save(folder / "membership.npy", gmap.membership.astype(np.float32))
        for name in ARCHIVES:
            if arrays := getattr(gmap, name):
                np.savez_compressed(folder / f"{name}.npz", **arrays)
        if still := info.get("scene", {}).get("still"):
            (folder / IGNORED).write_bytes(base64.b64decode(still["mask"]))
        _dump(folder / EDITABLE, {"instances": gmap.instances})
        if keep_report and (path / REPORT).is_file():
            shutil.copy2(path / REPORT, folder / REPORT)
        facts = json.loads(json.dumps(info, allow_nan=False, default=_plain))  # as it will be read
        _dump(folder / FACTS, seal({**facts, "files": {file.name: facts_of(file) for file in listed_files(folder)}}))


def _recorded(view: View, path: Path, before: Path | None) -> StoredView:
    """The record of a view for the map at `path`; before: path of the map it was read from, or None."""
    safe_name(view.name, path)
    if not isinstance(view, StoredView):
        return stored_view(view, path)
    return moved_record(view, path if before is None else before, path)


def read_map(path: Path) -> Map:
    """Reads a whole map into memory and verifies its checksums.
    InputError naming the file when it is not a map, of an unknown version, or damaged.

    >>> len(read_map(Path("kitchen.gsmap")).instances)
    9
    """
    return Map.open(path).load()


def verify_map(path: Path) -> dict[str, str]:
    """Reads every byte: {file: "ok", "edited" or "no checksum"}; InputError naming the first damaged file."""
    return verify(path, MapFiles(path).facts)


def set_labels(path: Path, labels: dict[int, str | None]) -> dict[int, str | None]:
    """Sets labels of instances, by id, in the map at `path`; None removes a label. All are written or none.

    Returns the written labels, with white space normalised. InputError for an unknown id, a label that is empty or too
    long, and while another writer holds the map.

    >>> set_labels(Path("kitchen.gsmap"), {0: "grandma's  cup"})
    {0: "grandma's cup"}
    """
    tidied = {i: None if label is None else tidy_label(label) for i, label in labels.items()}
    with writing(path):
        files = MapFiles(path)
        position = {entry["id"]: n for n, entry in enumerate(files.instances)}
        for instance_id, label in tidied.items():
            if instance_id not in position:
                raise InputError(f"{path}: has no instance {instance_id}; it has {len(position)}")
            files.instances[position[instance_id]]["label"] = label
        with contextlib.ExitStack() as both:  # both are written completely before the first rename
            facts = both.enter_context(atomic_file(path / FACTS, parents=False)) if "files" in files.facts else None
            aside = both.enter_context(atomic_file(path / EDITABLE, parents=False))
            _dump(aside, {"instances": files.instances})
            if facts is not None:  # other checksums are kept, so damage stays detectable
                _dump(facts, seal({**files.facts, "files": {**files.facts["files"], EDITABLE: facts_of(aside)}}))
    return tidied


def tidy_label(label: str) -> str:
    """`label` on one line without outer white space; InputError when it is empty or longer than LONGEST_LABEL."""
    tidy = " ".join(label.split())
    if not tidy:
        raise InputError('label: it is empty; write a name such as "grandma\'s cup", or --clear to take it away')
    if len(tidy) > LONGEST_LABEL:
        raise InputError(f"label: {len(tidy)} characters, at most {LONGEST_LABEL} are kept; choose a shorter name")
    if any("\ud800" <= letter <= "\udfff" for letter in tidy):
        raise InputError("label: it holds bytes that are no UTF-8, or half of a surrogate pair; write it in UTF-8")
    return tidy


def relink(path: Path, folder: Path) -> dict[str, Any]:
    """Records for every view of the map at `path` the photo below `folder` with the same name and size.

    A photo is searched by the view name ("a/0001.jpg") among the photos of its visit, then by the file name alone;
    capitals and small letters are the same. If the photo recorded before can still be read, only a copy of it is
    accepted. Otherwise several files may have the same name and size: the view takes the file whose folders match the
    recorded path best, and of several views that fit one file the best match gets it. Views without such a photo keep
    their record. Returns {"linked": count, "missing": names, "differ": names of photos of another size, which are no
    photos of other views}. InputError when no photo is found, when two views fit a photo equally well, or while the map
    is locked by another writer.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give the one that holds the photos of {path}")
    by_name: dict[str, list[Path]] = defaultdict(list)
    for file in sorted(folder.rglob("*")):
        by_name[folded(file.name)].append(file)
    named = NamedFiles(folder)
    with writing(path):
        files = MapFiles(path)
        entries, views = files.facts.get("views", []), files.read("views")
        claims, left = defaultdict[Path, list[tuple[float, StoredView]]](list), dict[str, list[Path]]()
        for view in views:
            alike = [file for file in by_name[folded(PurePosixPath(view.name).name)] if file.is_file()]
            exact = [file for file in map(named.find, (view.name, view.photo_name)) if file is not None]
            of_size = [[f for f in some if view.photo_bytes in (None, f.stat().st_size)] for some in (exact, alike)]
            fits = {file: _likeness(view, path, file) for file in (of_size[0][:1] or of_size[1])}
            best = [file for file, fit in fits.items() if fit == max(fits.values()) > 0]
            if len(best) == 1:
                claims[best[0]].append((fits[best[0]], view))
            else:
                left[view.name] = [] if of_size[1] else [*exact, *alike]
        found = {name: file for file, claim in claims.items() for name in _owners(file, claim)}
        left |= {view.name: [] for claim in claims.values() for _, view in claim if view.name not in found}
        linked = set(found.values())
        differ = [name for name, others in left.items() if not linked.issuperset(others)]
        missing = [name for name, others in left.items() if linked.issuperset(others)]
        if not linked:
            other = f", {len(differ)} have another size than the photos of the map" if differ else ""
            raise InputError(f"{folder}: holds none of the {len(entries)} photos of {path}{other}; give their folder")
        for entry, view in zip(entries, views, strict=True):
            if view.name in found:
                record = view_json(stored_view(view_from_json({**entry, "photo": str(found[view.name])}), path))
                entry |= {key: record[key] for key in ("photo", "photo_beside", "photo_bytes")}
        with atomic_file(path / FACTS, parents=False) as aside:
            _dump(aside, seal(files.facts) if "files" in files.facts else files.facts)
    return {"linked": len(found), "missing": missing, "differ": differ}


def _likeness(view: StoredView, path: Path, file: Path) -> float:
    """How well a file of the name and size of a photo fits the view: infinity or 0 where the photo can still be read,
    for they have the same bytes or not, else 1 plus the number of last parts in which its path is as recorded."""
    with contextlib.suppress(InputError):
        return math.inf if filecmp.cmp(locate_photo(view, path), file, shallow=False) else 0
    parts = [reversed(parts_of(folded(str(place)))) for place in (view.photo, absolute(file))]
    return 1 + sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(*parts, strict=False)))


def _owners(file: Path, claims: list[tuple[float, StoredView]]) -> list[str]:
    """Names of the views that `file` fits best, of those with their likeness; InputError when they had other photos."""
    most = max(fit for fit, _ in claims)
    best = [view for fit, view in claims if fit == most]
    other = next((view for view in best if view.photo != best[0].photo), None)
    if other is not None and most < math.inf:
        names = f"'{best[0].name}' and '{other.name}', which have one name and size"
        was = f"{best[0].photo.parent} or {other.photo.parent}"
        raise InputError(f"{file}: may be the photo of {names}; call its folder as it was called, {was}")
    return [view.name for view in best]


def write_gaussian_ply(path: Path, gmap: Map) -> None:
    """The standard 3DGS properties in their usual order; f_rest is channel-major (all R, then G, then B)."""
    rest = gmap.sh[:, 1:].transpose(0, 2, 1).reshape(len(gmap), -1)
    groups = {
        "xyz": gmap.means,
        ("nx", "ny", "nz"): np.zeros((len(gmap), 3)),
        tuple(f"f_dc_{i}" for i in range(3)): gmap.sh[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): gmap.opacity_logits[:, None],
        tuple(f"scale_{i}" for i in range(3)): gmap.log_scales,
        tuple(f"rot_{i}" for i in range(4)): gmap.quats,
    }
    columns = {name: values[:, i] for names, values in groups.items() for i, name in enumerate(names)}
    write_ply(path, {"vertex": {name: np.ascontiguousarray(column, np.float32) for name, column in columns.items()}})


def _dump(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, allow_nan=False, default=_plain) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")
