"""`perception models`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import Parser, command
from perception.progress import Progress


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    parser = commands.add_parser("models", help="the ONNX models of this user: list, check, add, get")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True, parser_class=Parser)
    command(kinds, "list", _list, "the models in the store")
    p = command(kinds, "check", _check, "family, inputs, outputs and providers really in use of an ONNX file")
    p.add_argument("file", metavar="FILE", help="an ONNX file, a folder of them, or a name of the store")
    p = command(kinds, "add", _add, "put a model into the store, from files")
    p.add_argument("name", metavar="NAME", help="use it as --masks sam:NAME or language.encoder=clip:NAME")
    p.add_argument("source", nargs="+", metavar="FILE", help="encoder and decoder, or a folder")
    p = command(kinds, "get", _get, "fetch a model of the catalogue from the Hugging Face hub, or list the catalogue")
    p.add_argument("name", metavar="NAME", nargs="?", help="an entry of the catalogue; none: list it")


def _list(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.onnx.store import models_folder, stored_models

    found = [
        {name: getattr(model, name) for name in ("name", "family", "purpose", "files")}
        | {"bytes": sum(int(entry["bytes"]) for entry in model.files), "folder": str(model.folder)}
        for model in stored_models()
    ]
    lines = [
        f"{m['name']:24} {m['purpose'] or '-':5} {m['family'] or 'unknown':14} {m['bytes'] / 1e6:9.1f} MB"
        for m in found
    ]
    return {"models": found}, "\n".join(lines) or f"no models in {models_folder()} yet (see perception models add)"


def _check(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.models import check_file

    found = check_file(args.file)
    lines = []
    for entry in found["files"]:
        what = f"{entry['family']} {entry['role']}" if entry["role"] else "of no known family"
        lines.append(f"{entry['file']}: {what}, {entry['bytes'] / 1e6:.1f} MB, runs on {', '.join(entry['providers'])}")
        for side in ("inputs", "outputs"):
            lines += [f"  {side[:-1]:6} {v['name']} {v['shape']} {v['type']}" for v in entry[side]]
    if found["left_out"]:
        lines.append(f"not used, of less precision: {', '.join(Path(f).name for f in found['left_out'])}")
    return found, "\n".join(lines + [f"warning: {text}" for text in found["warnings"]])


def _get(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.models import get_model
    from perception.onnx.store import catalogue

    if args.name is not None:
        return _described(get_model(args.name, Progress()))
    lines = [f"{n:16} {e.purpose:5} {e.licence:12} {e.repository} at {e.revision[:12]}" for n, e in catalogue().items()]
    return {"catalogue": list(catalogue())}, "\n".join(lines)


def _add(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.models import add_model

    return _described(add_model(args.name, args.source))


def _described(model: Any) -> tuple[dict[str, Any], str]:
    from perception.models import check_file

    warnings = check_file(str(model.folder))["warnings"]
    sam = f"--masks sam:{model.name}, or PERCEPTION_SAM={model.name} in the environment"
    use = {"sam": sam, "clip": f"--set language.encoder=clip:{model.name}"}
    lines = [f"{model.folder}: {model.family or 'unknown family'}"]
    lines += [f"  {entry['sha256']}  {entry['name']}" for entry in model.files]
    lines += [f"warning: {text}" for text in warnings]
    lines += [f"use it with {use[model.purpose]}"] if model.purpose else []
    result = {"name": model.name, "family": model.family, "purpose": model.purpose, "folder": str(model.folder)}
    return {**result, "files": model.files, "warnings": warnings}, "\n".join(lines)
