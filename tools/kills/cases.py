"""What is killed: mapping, updating, exporting, editing, upgrading, and what must hold afterwards."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TIMES = frozenset({"seconds", "profile", "peak_memory_mib", "skipped", "files", "sha256"})
"""Parts of map.json that tell what a run cost, not what it made."""

ARRAYS = ("means", "quats", "log_scales", "opacity_logits", "sh", "features", "instance_ids", "membership")


def command(*words: object) -> int:
    """Runs one `perception` command in this process."""
    from perception.cli import main

    return main([str(word) for word in words])


def contents(path: Path) -> str:
    """A digest of all that a map holds but what its run cost; opens it, and compares every checksum, on the way."""
    from perception import load_map
    from perception.map.write import read_map, verify_map

    load_map(path).find()
    assert set(verify_map(path).values()) <= {"ok", "edited"}, verify_map(path)
    gmap, digest = read_map(path), hashlib.sha256()
    for name in (*ARRAYS, "instances", "language", "parts"):
        _absorb(digest, name, getattr(gmap, name))
    _absorb(digest, "info", _lasting(gmap.info))
    _absorb(digest, "views", [[view.name, view.K.tolist(), view.camera_from_world.tolist()] for view in gmap.views])
    return digest.hexdigest()


def _lasting(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lasting(inner) for key, inner in value.items() if key not in TIMES}
    return [_lasting(inner) for inner in value] if isinstance(value, list) else value


def _absorb(digest: Any, name: str, value: Any) -> None:
    if isinstance(value, dict) and any(isinstance(inner, np.ndarray) for inner in value.values()):
        for key, inner in sorted(value.items()):
            _absorb(digest, f"{name}.{key}", inner)
    elif isinstance(value, np.ndarray):
        digest.update(f"{name} {value.dtype} {value.shape}".encode() + value.tobytes())
    else:
        digest.update(f"{name} {json.dumps(value, sort_keys=True)}".encode())


def names(folder: Path) -> list[str]:
    """What lies in `folder`, hidden files too."""
    return sorted(item.name for item in folder.iterdir())


def tree(folder: Path) -> dict[str, str]:
    """{path below `folder`: SHA-256 of the file}, hidden ones too."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


class Case:
    """One kind of work. `trial` numbers let a case alternate between its variants."""

    name: str
    variants = 1
    whole: list[Any]
    """What the undisturbed work of each variant left, once it has run."""

    def lay_out(self, place: Path, trial: int) -> None:
        """The state before the work begins."""
        raise NotImplementedError

    def work(self, place: Path, trial: int) -> int:
        """The work that is killed; the exit code."""
        raise NotImplementedError

    def again(self, place: Path, trial: int) -> int:
        """How a user goes on after the kill; the exit code."""
        return self.work(place, trial)

    def after_kill(self, place: Path, trial: int) -> str:
        """One word for what the kill left; AssertionError when something was lost."""
        raise NotImplementedError

    def result(self, place: Path, trial: int) -> Any:
        """What the finished work left, comparable bit for bit."""
        raise NotImplementedError


class Mapping(Case):
    """`perception map` of a folder of photos."""

    name = "mapping"
    settings = (
        "train.budget=1500",
        "densify.every=20",
        "instances.min_cluster_size=15",
        "instances.min_samples=5",
        "language.encoder=none",
        "photos.holdout=4",
        "photos.max_side=128",
    )

    def __init__(self, source: Path, labels: Path, iterations: int):
        self.source, self.labels, self.iterations = source, labels, iterations

    def lay_out(self, place: Path, trial: int) -> None:
        pass

    def words(self, out: Path) -> list[str]:
        """The command's arguments."""
        words = ["map", str(self.source), "-o", str(out), "--masks", f"labels:{self.labels}"]
        return [*words, "--iterations", str(self.iterations), *(f"--set={pair}" for pair in self.settings)]

    def work(self, place: Path, trial: int) -> int:
        from perception.pipeline import checkpoint

        checkpoint.CHECKPOINT_SECONDS = 0.2
        return command(*self.words(place / "out.gsmap"))

    def again(self, place: Path, trial: int) -> int:
        return command(*self.words(place / "out.gsmap"), "--resume")

    def after_kill(self, place: Path, trial: int) -> str:
        if not (place / "out.gsmap").exists():
            return "not yet"
        contents(place / "out.gsmap")
        return "whole"

    def result(self, place: Path, trial: int) -> Any:
        assert names(place) == ["out.gsmap"], names(place)
        assert (place / "out.gsmap" / "report.html").read_text().rstrip().endswith("</html>")
        return contents(place / "out.gsmap"), names(place / "out.gsmap")


class Updating(Mapping):
    """`perception update` of the map `old` with the photos of another visit."""

    name = "updating"

    def __init__(self, old: Path, visit: Path):
        self.old, self.visit = old, visit

    def words(self, out: Path) -> list[str]:
        masks = f"labels:{self.visit / 'labels'}"
        return ["update", str(self.old), str(self.visit), "-o", str(out), "--masks", masks]


class Exporting(Case):
    """`perception export` with every kind of file; odd trials overwrite an older export."""

    name = "exporting"
    variants = 2

    def __init__(self, gmap: Path, cloud: Path, older: Path):
        self.gmap, self.cloud, self.older = gmap, cloud, older

    def lay_out(self, place: Path, trial: int) -> None:
        shutil.copytree(self.gmap, place / "m.gsmap")
        if trial % 2:
            shutil.copytree(self.older, place / "out")
        else:
            (place / "out").mkdir()

    def work(self, place: Path, trial: int) -> int:
        return self.export(place)

    def export(self, place: Path, *more: object) -> int:
        """One export into the folder `out`; the exit code."""
        out = place / "out"
        words = ["export", place / "m.gsmap", "--points", self.cloud, "-o", out / "cloud.ply", "--color", "instance"]
        return command(*words, *more)

    def after_kill(self, place: Path, trial: int) -> str:
        assert tree(place / "m.gsmap") == tree(self.gmap), "the exported map changed"
        whole, old = self.whole[trial % 2], tree(self.older) if trial % 2 else {}
        here = {name: digest for name, digest in tree(place / "out").items() if not _aside(name)}
        wrong = [name for name, digest in here.items() if digest not in (whole.get(name), old.get(name))]
        assert not wrong, f"neither the old file nor the new one: {wrong}"
        assert not [name for name in old if name not in here], "a file of the older export is gone"
        if here.get("cloud.ply") == whole["cloud.ply"]:
            assert here == whole, "the cloud, written last, lies there before the rest does"
        return "all files" if here == whole else "not all files"

    def result(self, place: Path, trial: int) -> Any:
        return tree(place / "out")


def _aside(name: str) -> bool:
    return any(part.startswith(".") for part in Path(name).parts)


class Editing(Case):
    """`perception label`, the viewer's corrections saved, in turns."""

    name = "editing"
    variants = 2

    def __init__(self, gmap: Path):
        self.gmap = gmap

    def lay_out(self, place: Path, trial: int) -> None:
        shutil.copytree(self.gmap, place / "m.gsmap")

    def work(self, place: Path, trial: int) -> int:
        path = place / "m.gsmap"
        kinds: list[Callable[[], int]] = [
            lambda: command("label", path, 1, "grandma's cup"),
            lambda: corrections(path),
        ]
        return kinds[trial % 2]()

    def again(self, place: Path, trial: int) -> int:
        if trial % 2 == 1 and self.after_kill(place, trial) == "after":
            return command("label", place / "m.gsmap", 0, "the table")  # what is merged cannot be merged again
        return self.work(place, trial)

    def after_kill(self, place: Path, trial: int) -> str:
        now, whole = contents(place / "m.gsmap"), self.whole[trial % 2]
        before = contents(self.gmap)
        assert now in (before, whole[0]), "neither the map from before nor the edited one"
        return "before" if now == before else "after"

    def result(self, place: Path, trial: int) -> Any:
        assert names(place) == ["m.gsmap"], names(place)
        return contents(place / "m.gsmap"), names(place / "m.gsmap")


class Keeping(Case):
    """One of `KEPT`, on a map in whose folder its user keeps photos, notes, a link and folders of his own.

    They must lie there after every kill, before anything has put the map in order.
    """

    def __init__(self, name: str, gmap: Path):
        self.name, self.gmap = name, gmap

    def lay_out(self, place: Path, trial: int) -> None:
        path = place / "m.gsmap"
        shutil.copytree(self.gmap, path)
        (path / "photos" / "raw").mkdir(parents=True)
        for n in range(12):
            (path / "photos" / f"{n}.jpg").write_bytes(bytes([n]) * 5000)
        (path / "photos" / "raw" / "0.dng").write_text("raw")
        (path / "notes.txt").write_text("where the key lies")
        (path / "notes.txt").chmod(0o444)
        (path / ".hidden").touch()
        (path / "empty").mkdir()
        (path / "elsewhere").symlink_to("/no/such/place")
        self.kept = users(path)

    def work(self, place: Path, trial: int) -> int:
        return KEPT[self.name](place / "m.gsmap")

    def after_kill(self, place: Path, trial: int) -> str:
        path = place / "m.gsmap"
        assert users(path) == self.kept, "something of the user's is gone or has changed"
        now = contents(path)
        assert now in (contents(self.gmap), self.whole[0][0]), "neither the map from before nor the new one"
        return "before" if now == contents(self.gmap) else "after"

    def result(self, place: Path, trial: int) -> Any:
        assert names(place) == ["m.gsmap"], names(place)
        path = place / "m.gsmap"
        assert users(path) == self.kept, "something of the user's is gone or has changed"
        return contents(path), {name: digest for name, digest in tree(path).items() if name.startswith("labelled")}


def users(path: Path) -> dict[str, str]:
    """{path below a map's folder: what it is} of all that `Keeping` laid there."""
    found = {}
    for item in sorted(path.rglob("*")):
        name = str(item.relative_to(path))
        if name.split("/")[0] in ("photos", "notes.txt", ".hidden", "empty", "elsewhere"):
            kind = f"link {item.readlink()}" if item.is_symlink() else "folder" if item.is_dir() else item.read_text()
            found[name] = f"{item.lstat().st_mode:o} {kind}"
    return found


def _save(path: Path) -> int:
    from perception.edit.editor import Editor

    editor = Editor(path)
    editor.rename(editor.instances[0]["id"], "the table")
    editor.save()
    return 0


KEPT: dict[str, Callable[[Path], int]] = {
    "save": _save,
    "upgrade": lambda path: command("upgrade", path),
    "export": lambda path: command("export", path, "-o", path / "labelled.ply"),
}
"""Work on a map whose folder holds more than the map."""


def corrections(path: Path) -> int:
    """What a person does in the viewer: rename, merge, remove, undo; then save."""
    from perception.edit.editor import Editor

    editor = Editor(path)
    ids = [entry["id"] for entry in editor.instances]
    editor.rename(ids[0], "the table")
    editor.merge(ids[1:3])
    editor.remove(editor.instances[-1]["id"])
    editor.undo()
    editor.save()
    return 0
