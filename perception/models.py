"""`perception models`: recognises ONNX files by their inputs and outputs, and adds them to the user's store."""

from __future__ import annotations

import json
import os
import shutil
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perception.errors import InputError, home_path, missing_extra
from perception.io.atomic import atomic_directory
from perception.io.documents import brief
from perception.map.checksums import facts_of, sha256
from perception.onnx.sessions import model_graphs, model_root, refuse_outside_weights, side_files
from perception.onnx.store import NAME, RECORD, Entry, StoredModel, catalogue, find_model, known_names, models_folder
from perception.progress import QUIET, Progress

_KEPT = (".json", ".txt")  # of a folder, beside graphs and their weights: configurations and tokenizers
_PURPOSES = {"encoder": "sam", "decoder": "sam", "image tower": "clip", "text tower": "clip", "both towers": "clip"}


def check_file(file: str) -> dict[str, Any]:
    """Describes an ONNX file, a folder of them or a stored model: `describe_graph` of each under "files", and warnings.
    InputError when a file is not an ONNX model, and for a SAM encoder and decoder that do not fit together."""
    stored = find_model(file)
    path = stored.folder if stored and not Path(file).exists() else home_path(file)
    left_out: list[Path] = []
    if path.is_dir():
        graphs, left_out = model_graphs(path)
    elif path.is_file():
        graphs = [path]
    else:
        raise InputError(f"{file}: no such file, folder or stored model; {known_names()}")
    found = [describe_graph(graph) for graph in graphs]
    family, purpose, problem = judge(found)
    notes = [text for text in (*(entry.pop("warning") for entry in found), problem) if text]
    if not problem:
        notes += _opened(purpose, str(path))
    unused = [str(graph) for graph in left_out]
    facts = {"model": str(path), "family": family, "purpose": purpose, "files": found, "left_out": unused}
    return {**facts, "warnings": list(dict.fromkeys(notes))}


def _opened(purpose: str | None, spec: str) -> list[str]:
    """Warnings of the model when it is opened as for use, where towers or encoder and decoder must fit together."""
    from perception.language.clip import ClipEncoder
    from perception.masks.sam_models import open_sam

    if purpose == "sam":
        return open_sam(spec).warnings
    if purpose == "clip":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the providers, which every file repeats
            try:
                ClipEncoder.from_spec(spec)
            except InputError as error:
                return [f"cannot be used: {error}"]
    return []


def describe_graph(path: Path) -> dict[str, Any]:
    """Family, role, inputs, outputs and providers of one ONNX file."""
    from perception.masks.sam_models import open_graph
    from perception.onnx.sessions import provider_warning

    graph = open_graph(path)
    family, role = recognise(graph)
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "family": family,
        "role": role,
        "inputs": _arguments(graph.session.get_inputs()),
        "outputs": _arguments(graph.session.get_outputs()),
        "providers": list(graph.session.get_providers()),
        "warning": provider_warning(path, graph.session),
    }


def recognise(graph: Any) -> tuple[str | None, str | None]:
    """(family, role) of an opened graph; (None, None) for an unsupported model."""
    from perception.language.preprocess import family_of
    from perception.masks.sam_models import decoder_family, encoder_family

    if graph.is_decoder:
        return decoder_family(graph).name, "decoder"
    inputs, outputs = graph.session.get_inputs(), graph.session.get_outputs()
    rows = any(len(value.shape) == 2 for value in outputs)
    pixels = any(len(value.shape) == 4 for value in inputs)
    tokens = any(len(value.shape) == 2 and "int" in value.type and "mask" not in value.name for value in inputs)
    if rows and (pixels or tokens):
        role = "both towers" if pixels and tokens else "image tower" if pixels else "text tower"
        family = family_of(graph.path)
        return family.name if family else "CLIP-like", role
    return (encoder_family(graph), "encoder") if graph.is_encoder else (None, None)


def _arguments(values: Any) -> list[dict[str, Any]]:
    return [{"name": value.name, "shape": list(value.shape), "type": value.type} for value in values]


def judge(found: Sequence[dict[str, Any]]) -> tuple[str | None, str | None, str]:
    """(family, purpose, text on missing files) of the files of one model."""
    known = [entry for entry in found if entry["role"]]
    if not known:
        return None, None, "the family is unknown: neither a SAM nor a CLIP export was recognised"
    purpose = _PURPOSES[known[0]["role"]]
    family = next((e["family"] for e in known if e["role"] in ("decoder", "image tower")), known[0]["family"])
    roles = {entry["role"] for entry in known}
    needed = {"sam": {"encoder", "decoder"}, "clip": {"image tower", "text tower"}}[purpose]
    lacking = set() if "both towers" in roles else needed - roles
    return family, purpose, f"the {' and '.join(sorted(lacking))} is missing; both are needed" if lacking else ""


def add_model(name: str, sources: Sequence[str]) -> StoredModel:
    """Adds files (or all files of a folder) to the store under `name`, all or none."""
    if not NAME.fullmatch(name):
        raise InputError(f"model name '{name}': expected letters, digits, '.', '_' or '-', as in mobile-sam")
    return _install(name, [file for source in sources for file in _local(source)])


def get_model(name: str, progress: Progress = QUIET) -> StoredModel:
    """Fetches an entry of the catalogue from the Hugging Face hub, or its mirror HF_ENDPOINT, into the store under its
    name, unless it is there. Files are verified by their known digests."""
    entry = catalogue().get(name)
    if entry is None:
        raise InputError(f"models get {name}: not in the catalogue; it holds {', '.join(catalogue())}")
    sizes = [size for size, _ in entry.files.values()]
    size = f", {sum(sizes) / 1e6:.1f} MB" if None not in sizes else ""
    files = f"{len(sizes)} files{size}, of {entry.repository} at {entry.revision[:12]}"
    progress.log(f"{name}: {files}, licence {entry.licence}, to {models_folder() / name}")
    known = find_model(name)
    if known is None or not _holds(known, entry):
        parts = models_folder() / ".parts" / name
        known = _install(name, [_fetched(entry, path, parts) for path in entry.files])
        shutil.rmtree(parts, ignore_errors=True)  # another process may have fetched it, too
    return known


def _holds(model: StoredModel, entry: Entry) -> bool:
    """Whether the stored model has all files of a catalogue entry, with the known digests."""
    held = {file["name"]: file["sha256"] for file in model.files if (model.folder / file["name"]).is_file()}
    wanted = {Path(path).name: digest for path, (_, digest) in entry.files.items()}
    return all(name in held and digest in (None, held[name]) for name, digest in wanted.items())


def _fetched(entry: Entry, path: str, folder: Path) -> tuple[str, Path, str]:
    """(file name, path below `folder`, address) of a downloaded file; what an interrupted call received is kept."""
    try:
        import huggingface_hub as hub
        from huggingface_hub.utils import disable_progress_bars
    except ImportError as error:
        raise missing_extra("huggingface-hub", "demo") from error
    if not sys.stderr.isatty():
        disable_progress_bars()
    endpoint = os.environ.get("HF_ENDPOINT") or None  # the library reads it once, when it is imported
    version: dict[str, Any] = {"revision": entry.revision, "endpoint": endpoint}
    address = hub.hf_hub_url(entry.repository, path, **version)
    try:
        file = Path(hub.hf_hub_download(entry.repository, path, local_dir=folder, **version))
    except (OSError, ValueError, RuntimeError) as error:  # its own and its HTTP library's errors among them
        reason = brief(error.__cause__ or error, 200)
        raise InputError(f"{address}: cannot be fetched ({reason}); run the command again to go on") from error
    expected = entry.files[path][1]
    if expected not in (None, found := sha256(file)):
        file.unlink()
        raise InputError(f"{address}: sha256 is {found}, expected {expected}; what was fetched is thrown away")
    return file.name, file, address


def _local(source: str) -> list[tuple[str, Path, str]]:
    """(file name, path, source) of a file with its side files, or of the files of a folder."""
    path = home_path(source)
    if path.is_dir():
        root, graphs = model_root(path), model_graphs(path)[0]
        for graph in graphs:
            refuse_outside_weights(graph)
        files = [*graphs, *(f for graph in graphs for f in side_files(graph) if f.is_file())]
        files += [f for f in sorted(root.rglob("*")) if f.is_file() and f.suffix in _KEPT and f.name != RECORD]
        return [(str(f.relative_to(root)), f, str(f)) for f in files]
    if not path.is_file():
        raise InputError(f"{source}: no such file or folder")
    files = [path]
    if path.suffix == ".onnx":
        refuse_outside_weights(path)
        files += [file for file in side_files(path) if file.is_file()]
    return [(str(p.relative_to(path.parent)), p, str(p)) for p in files]


def _install(name: str, files: Sequence[tuple[str, Path, str]]) -> StoredModel:
    names = [file_name for file_name, _, _ in files]
    if twice := {n for n in names if names.count(n) > 1}:
        raise InputError(f"models add {name}: two files are called {', '.join(sorted(twice))}; rename one")
    if not any(n.endswith(".onnx") for n in names):
        raise InputError(f"models add {name}: no .onnx file among {', '.join(names) or 'nothing'}")
    target, known = models_folder() / name, find_model(name)
    made = {RECORD, *(file["name"] for file in ([] if known is None else known.files))}
    for file in target.rglob("*"):
        if (file.is_symlink() or not file.is_dir()) and str(file.relative_to(target)) not in made:
            raise InputError(f"{file}: was not added as a part of '{name}', and would be lost; move it elsewhere")
    with atomic_directory(target) as folder:
        entries = []
        for file_name, path, source in files:
            copy = folder / file_name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            entries.append({"name": file_name, "source": source, **facts_of(copy)})
        family, purpose, _ = judge([describe_graph(graph) for graph in sorted(folder.rglob("*.onnx"))])
        record = json.dumps({"family": family, "purpose": purpose, "files": entries}, indent=1)
        (folder / RECORD).write_text(record + "\n", encoding="utf-8")
    return StoredModel(name, target, family, purpose, entries)
