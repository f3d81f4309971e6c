"""`perception models`: recognises ONNX files by their inputs and outputs, and adds them to the user's store."""

from __future__ import annotations

import hashlib
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from perception.errors import InputError
from perception.io.atomic import atomic_directory
from perception.io.checksums import facts_of, sha256
from perception.io.model_store import (
    RECORD,
    StoredModel,
    catalogue,
    check_name,
    download,
    find_model,
    is_url,
    known_names,
    models_folder,
    set_default,
    stored_models,
    write_record,
)
from perception.io.onnx_sessions import model_graphs, model_root, side_files
from perception.progress import Progress

_KEPT = (".json", ".txt")  # of a folder, beside graphs and their weights: configurations and tokenizers
_PURPOSES = {"encoder": "sam", "decoder": "sam", "image tower": "clip", "text tower": "clip", "both towers": "clip"}


def check_file(file: str) -> dict[str, Any]:
    """Describes an ONNX file, a folder of them or a stored model: one dict per file under "files", and warnings.

    Each: file, family, role, inputs and outputs with shapes, providers (those in use). Raises InputError when a
    file is not an ONNX model, and for a SAM encoder and decoder that do not fit together.
    """
    stored = find_model(file)
    path = stored.folder if stored and not Path(file).exists() else Path(file).expanduser()
    left_out: list[Path] = []
    if path.is_dir():
        graphs, left_out = model_graphs(path)
        if not graphs:
            raise InputError(f"{path}: no .onnx file in this folder; expected ONNX models")
    elif path.is_file():
        graphs = [path]
    else:
        raise InputError(f"{file}: no such file, folder or stored model; {known_names()}")
    found = [describe_graph(graph) for graph in graphs]
    family, purpose, problem = judge(found)
    told = [text for text in (*(entry.pop("warning") for entry in found), problem) if text]
    if not problem:
        told += _opened(purpose, str(path))
    unused = [str(graph) for graph in left_out]
    about = {"model": str(path), "family": family, "purpose": purpose, "files": found, "left_out": unused}
    return {**about, "warnings": list(dict.fromkeys(told))}


def _opened(purpose: str | None, spec: str) -> list[str]:
    """Warnings of the model when it is opened as for use, where towers or encoder and decoder must fit together."""
    from perception.language.clip import ClipEncoder
    from perception.masks.sam_models import open_sam

    if purpose == "sam":
        return open_sam(spec).warnings
    if purpose == "clip":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the providers, which every file tells
            try:
                ClipEncoder.from_spec(spec)
            except InputError as error:
                return [f"cannot be used: {error}"]
    return []


def describe_graph(path: Path) -> dict[str, Any]:
    """Family, role, inputs, outputs and providers of one ONNX file."""
    from perception.io.onnx_sessions import provider_warning
    from perception.masks.sam_models import open_graph

    graph = open_graph(path)
    family, role = recognise(graph)
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "family": family,
        "role": role,
        "inputs": [_argument(value) for value in graph.session.get_inputs()],
        "outputs": [_argument(value) for value in graph.session.get_outputs()],
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


def _argument(value: Any) -> dict[str, Any]:
    return {"name": value.name, "shape": list(value.shape), "type": value.type}


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


def list_models() -> list[dict[str, Any]]:
    """Name, family, purpose, bytes and folder of each stored model."""
    fields = ("name", "family", "purpose", "files")
    return [
        {field: getattr(model, field) for field in fields}
        | {"bytes": sum(int(entry["bytes"]) for entry in model.files), "folder": str(model.folder)}
        for model in stored_models()
    ]


def add_model(
    name: str,
    sources: Sequence[str],
    *,
    sha256: Sequence[str | None] = (),
    default: bool = False,
    progress: Progress | None = None,
) -> StoredModel:
    """Adds files (or all files of a folder, or URLs) to the store under `name`, all or none.

    sha256: expected digests, as many as sources or none. A URL that is already stored under that name is not downloaded
    again. default: `--masks auto` uses this model from now on.
    """
    check_name(name)
    if sha256 and len(sha256) != len(sources):
        raise InputError(f"--sha256: {len(sha256)} digests for {len(sources)} files; give one for each, in order")
    expected = {source: digest.lower() for source, digest in zip(sources, sha256, strict=False) if digest is not None}
    for digest in expected.values():
        if len(digest) != 64 or set(digest) - set("0123456789abcdef"):
            raise InputError(f"--sha256 {digest[:70]}: expected 64 hexadecimal digits")
    known = find_model(name)
    if known is None or not _same(known, sources, expected):
        files = [file for source in sources for file in _local(source, expected.get(source), progress)]
        known = _install(name, files)
        for source in sources:
            _part(source).unlink(missing_ok=True)
    if default:
        set_default(known)
    return known


def get_model(name: str, *, default: bool = False, progress: Progress | None = None) -> StoredModel:
    """Fetches an entry of the catalogue into the store under its name, resumed and verified by size and digest.

    What is fetched is told before.
    """
    entry = catalogue().get(name)
    if entry is None:
        raise InputError(f"models get {name}: not in the catalogue; it holds {', '.join(catalogue())}")
    if progress is not None:
        sizes = [size for size, _ in entry.files.values()]
        size = f", {sum(sizes) / 1e6:.1f} MB" if None not in sizes else ""
        told = f"{len(sizes)} files{size}, of {entry.repository} at {entry.revision[:12]}"
        progress.log(f"{name}: {told}, licence {entry.licence}, to {models_folder() / name}")
    digests = entry.addresses()
    return add_model(name, list(digests), sha256=list(digests.values()), default=default, progress=progress)


def _same(model: StoredModel, sources: Sequence[str], expected: dict[str, str]) -> bool:
    """Whether the stored model was made from the same URLs, with the same digests."""
    if not all(is_url(source) for source in sources) or [f["source"] for f in model.files] != list(sources):
        return False
    whole = all((model.folder / f["name"]).is_file() for f in model.files)
    return whole and all(expected.get(f["source"], f["sha256"]) == f["sha256"] for f in model.files)


def _local(source: str, expected: str | None, progress: Progress | None) -> list[tuple[str, Path, str]]:
    """(file name, current path, source) of a download, a file with its side files, or the files of a folder."""
    if is_url(source):
        file_name = Path(unquote(urlparse(source).path)).name.lstrip(".") or "model.onnx"
        part = download(source, _part(source), progress, file_name)
        if expected not in (None, found := sha256(part)):
            part.unlink()
            raise InputError(f"{source}: sha256 is {found}, expected {expected}; what was fetched is thrown away")
        return [(file_name, part, source)]
    path = Path(source).expanduser()
    if path.is_dir():
        root, graphs = model_root(path), model_graphs(path)[0]
        files = [*graphs, *(f for graph in graphs for f in side_files(graph) if f.is_file())]
        files += [f for f in sorted(root.rglob("*")) if f.is_file() and f.suffix in _KEPT and f.name != RECORD]
        return [(str(f.relative_to(root)), f, str(f)) for f in files]
    if not path.is_file():
        raise InputError(f"{source}: no such file or folder, and no http(s) address")
    if expected not in (None, found := sha256(path)):
        raise InputError(f"{source}: sha256 is {found}, expected {expected}; is it the right file?")
    beside = side_files(path) if path.suffix == ".onnx" else []
    return [(str(p.relative_to(path.parent)), p, str(p)) for p in [path, *beside] if p.is_file()]


def _install(name: str, files: Sequence[tuple[str, Path, str]]) -> StoredModel:
    names = [file_name for file_name, _, _ in files]
    twice = {n for n in names if names.count(n) > 1}
    if twice:
        raise InputError(f"models add {name}: two files are called {', '.join(sorted(twice))}; rename one")
    if not any(n.endswith(".onnx") for n in names):
        raise InputError(f"models add {name}: no .onnx file among {', '.join(names) or 'nothing'}")
    with atomic_directory(models_folder() / name) as folder:
        entries = []
        for file_name, path, source in files:
            target = folder / file_name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
            entries.append({"name": file_name, "source": source, **facts_of(target)})
        family, purpose, _ = judge([describe_graph(graph) for graph in sorted(folder.rglob("*.onnx"))])
        write_record(folder, family, purpose, entries)
    return StoredModel(name, models_folder() / name, family, purpose, entries)


def _part(source: str) -> Path:
    return models_folder() / ".parts" / f"{hashlib.sha256(source.encode()).hexdigest()[:24]}.part"
