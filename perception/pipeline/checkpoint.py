"""Training state on disk, written whole or not at all, and refused when the settings have changed."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
from pathlib import Path
from typing import Any

from perception.config import MapConfig
from perception.errors import InputError
from perception.io.atomic import atomic_file


def fingerprint(source: Path, config: MapConfig) -> str:
    """What a checkpoint depends on. When to stop is left out: giving more time to a stopped run is the point."""
    settings = config.to_json()
    for name in ("time_limit", "stop_psnr"):
        del settings["train"][name]
    text = json.dumps([str(source.resolve()), settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def save_checkpoint(path: Path, state: dict[str, Any], mark: str) -> None:
    """Writes `state` under the settings' fingerprint `mark`."""
    import torch

    buffer = io.BytesIO()  # torch's own file writer ends the process where the disk is full
    torch.save({"mark": mark, "state": state}, buffer)
    with atomic_file(path) as aside:
        aside.write_bytes(buffer.getbuffer())


def load_checkpoint(path: Path, mark: str) -> dict[str, Any] | None:
    """The state kept at `path`; None when there is none. InputError when it is damaged or belongs to other settings."""
    import torch

    if not path.is_file():
        return None
    try:
        held = torch.load(path, weights_only=True)
        found, state = held["mark"], held["state"]
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: the checkpoint is damaged; delete {path.parent} to start over") from error
    if found != mark:
        raise InputError(
            f"{path}: was made with other settings or another input; repeat the first command with --resume, "
            f"or delete {path.parent} to start over"
        )
    return state
