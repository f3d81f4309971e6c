"""What a run is made from: its input files by name, size and time of change.

The work folder of an unfinished run lists them, and map.json of a finished one. `--resume` compares them with today's.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

from perception.config import MapConfig
from perception.errors import InputError, home_path
from perception.inputs.load import input_files
from perception.io.atomic import write_file
from perception.io.documents import read_json, refusing
from perception.map.checksums import is_map
from perception.map.files import read_info
from perception.map.map import Map
from perception.map.write import read_map
from perception.masks.sam_models import sam_graphs
from perception.onnx.sessions import side_files
from perception.onnx.store import resolve
from perception.photos.folder import list_photos
from perception.photos.named_files import folded
from perception.pipeline.checkpoint import INPUTS, clear_work, frames_folder, work_folder
from perception.progress import Progress

CONFIGURATIONS = (
    *("config.json", "tokenizer.json", "tokenizer_config.json"),
    *("preprocessor_config.json", "preprocess_cfg.json", "open_clip_config.json"),
)
"""Files that are read in the folder of a model, or above it."""
SHOWN = 3

Inputs = dict[str, dict[str, str]]
"""By "SETTING=PATH", of each file that PATH names: "BYTES NANOSECONDS", its size and time of change."""


def inputs_of(source: Path, config: MapConfig, output: Path) -> Inputs:
    """The files that the map of `source` at `output` is made from, without those that its run writes.
    InputError where `source` is no input, or lists its photos in a file that cannot be read."""
    own = {_real(folder) for folder in (output, work_folder(output), frames_folder(output))}
    found: Inputs = {}
    try:
        for setting, path, files in _named(source.absolute(), config, frames_folder(output).absolute()):
            base, others = path if path.is_dir() else path.parent, own - {_real(path)}
            folders = {folder: _real(folder) for folder in {file.parent for file in files}}
            written = {folder for folder, real in folders.items() if others & {real, *real.parents}}
            stats = {file: file.stat() for file in files if file.parent not in written}
            facts = {os.path.relpath(file, base): f"{stat.st_size} {stat.st_mtime_ns}" for file, stat in stats.items()}
            found.setdefault(f"{setting}={_real(path)}", {}).update(facts)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); allow it, or remove it") from error
    return found


def _real(path: Path) -> Path:
    """The path without links, as far as they lead anywhere."""
    return Path(os.path.realpath(path))


def _named(source: Path, config: MapConfig, frames: Path) -> Iterator[tuple[str, Path, list[Path]]]:
    """(setting, absolute path that it names, the files there)."""
    photos, (kind, _, masks) = config.photos, config.masks.partition(":")
    yield "input", source, input_files(source)
    if source.is_file() and frames.is_dir():
        yield "frames", frames, list_photos(frames)
    if config.splat.cameras is not None:
        cameras = Path(config.splat.cameras).absolute()
        yield "splat.cameras", cameras, input_files(cameras)
    for setting in ("camera", "init_points", "held_out"):
        if name := getattr(photos, setting):
            file = Path(name).absolute()
            yield f"photos.{setting}", file, [file] if file.is_file() else []
    for setting, name in (("photos.ignore_masks", photos.ignore_masks), ("masks", masks if kind == "labels" else "")):
        if name:
            folder = Path(name).absolute()
            yield setting, folder, list_photos(folder, frozenset({".png"})) if folder.is_dir() else []
    sam = os.environ.get("PERCEPTION_SAM", "").strip() if kind == "auto" else masks if kind == "sam" else ""
    encoder, _, clip = config.language.encoder.partition(":")
    for setting, model in (("masks", sam), ("language.encoder", clip if encoder == "clip" else "")):
        for part in resolve(model).split(",") if model else ():
            path = home_path(part.strip()).absolute()
            yield setting, path, _model_files(path)


def _model_files(path: Path) -> list[Path]:
    """The ONNX files at `path`, and those that hold their weights and configurations."""
    graphs = sam_graphs(path) if path.exists() else []
    folders = dict.fromkeys(folder for graph in graphs for folder in list(graph.parents)[:2])
    files = [file for graph in graphs for file in (graph, *side_files(graph))]
    files += [folder / name for folder in folders for name in CONFIGURATIONS]
    return [file for file in files if file.is_file()]


def hold_inputs(work: Path, source: Path, config: MapConfig, output: Path) -> Inputs:
    """The run's input files, kept in `work`. InputError where they have changed since they were kept first: poses and
    training are not of them. Files of a setting that has another value now are not compared."""
    now, file = inputs_of(source, config, output), work / INPUTS
    before: Any = {}
    if file.is_file():
        before = read_json(file)
    elif any(not path.name.startswith(".") for path in work.iterdir()):
        what = "an older version began this run and recorded no input files, which may have changed since"
        raise InputError(f"{work}: {what}; remove the folder to start over")
    todo = f"choose another -o, or remove {work} to start over"
    if not isinstance(before, dict):
        raise InputError(f"{file}: is damaged; {todo}")
    both = before.keys() & now.keys()
    _compare(work, {key: before[key] for key in both}, {key: now[key] for key in both}, "since this run began", todo)
    write_file(file, json.dumps({**before, **now}))
    return now


def refuse_unnamed(inputs: Inputs, config: MapConfig) -> None:
    """InputError where a folder of masks or of label images holds no PNG that is named as a photo."""
    photos = sorted(name for key, names in inputs.items() if key.startswith(("input=", "frames=")) for name in names)
    stems = {folded(PurePath(name).stem) for name in photos}
    if len(photos) < 2:  # a video, or a finished splat, whose frames are not there yet
        return
    folders = ["photos.ignore_masks", *(["masks"] if config.masks.startswith("labels:") else [])]
    for key, files in inputs.items():
        setting, _, folder = key.partition("=")
        named = ({folded(PurePath(name).stem), folded(PurePath(PurePath(name).stem).stem)} for name in files)
        if setting in folders and Path(folder).is_dir() and not any(stems & either for either in named):
            such = f"expected a PNG of the same stem for each, such as {PurePath(photos[0]).stem}.png"
            found = f"none of its {len(files)} PNG files is named as a photo" if files else "holds no PNG"
            raise InputError(f"{folder}: {found}; {such}")


def finished(source: Path, output: Path, config: MapConfig, mark: str, progress: Progress) -> Map | None:
    """The finished map whose fingerprint is `mark`, if any. InputError when its input files have changed since."""
    if not is_map(output) or (info := read_info(output)).get("fingerprint") != mark:
        return None
    refuse_changed(output, info, inputs_of(source, config, output))
    progress.log(f"{output}: this run is finished")
    clear_work(output)
    return read_map(output)


def refuse_changed(output: Path, info: dict[str, Any], now: Inputs) -> None:
    """InputError where the finished map with `info` in its map.json was made from other files, or lists none."""
    todo = "choose another -o, or remove this map first"
    if "inputs" not in info:
        what = "an older version made this map and recorded no input files, which may have changed since"
        raise InputError(f"{output}: {what}; {todo}")
    _compare(output, info["inputs"], now, "since this map was made", todo)


def _compare(source: Path, before: Any, now: Inputs, since: str, todo: str) -> None:
    """InputError with the first files that differ."""
    with refusing(f"{source}: its list of input files is damaged; {todo}"):
        old, new = ({(key, name): stat for key in one for name, stat in one[key].items()} for one in (before, now))
    state = dict.fromkeys(old, "gone") | {key: "changed" if key in old else "new" for key in new}
    changed = [f"{key[1]} ({state[key]})" for key in sorted(state) if old.get(key) != new.get(key)]
    if changed:
        shown = ", ".join(changed[:SHOWN]) + (f" and {len(changed) - SHOWN} more" if len(changed) > SHOWN else "")
        raise InputError(f"{source}: input files are others {since}, {len(changed)} in all: {shown}; {todo}")
