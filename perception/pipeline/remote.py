"""Maps from photos in an object store, and into one: `build_map` between paths or URLs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from perception.config import MapConfig
from perception.errors import InputError
from perception.io.map_files import read_info
from perception.io.model_store import cache_folder
from perception.io.object_store import fetch, is_url, publish, published
from perception.pipeline.checkpoint import digest, fingerprint
from perception.pipeline.engine import Engine
from perception.pipeline.mapping import build_map
from perception.pipeline.reporting import write_own_report
from perception.progress import Progress


def make_map(
    source: Path | str,
    output: Path | str,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> dict[str, Any]:
    """`build_map` with its report; returns the content of map.json.

    Photos at a URL are copied to the folder NAME.input beside the map, which needs them. A map for a URL is made in the
    cache, and removed there once it is in the store. InputError as `build_map`, and for stores that cannot be read or
    written.
    """
    progress = progress or Progress(quiet=True)
    if not is_url(output):
        return _made(source, Path(output), config, resume, progress, engine)
    url = str(output)
    found = published(url)
    if found is not None:
        if resume and _same(found, source, config):
            progress.log(f"{url}: this run is finished")
            return found
        raise InputError(f"{url}: exists already; choose another -o or remove it first")
    stage = cache_folder() / "unpublished" / digest(url)
    local = stage / url.rstrip("/").rpartition("/")[2]
    info = _made(source, local, config, resume or local.exists(), progress, engine)
    publish(local, url, progress)
    shutil.rmtree(stage)
    progress.log(f"{url}: written")
    return info


def _made(
    source: Path | str, output: Path, config: MapConfig, resume: bool, progress: Progress, engine: Engine | None
) -> dict[str, Any]:
    photos = fetch(str(source), output.with_suffix(".input"), progress) if is_url(source) else Path(source)
    build_map(photos, output, config, resume=resume, progress=progress, engine=engine, origin=str(source))
    write_own_report(output, progress)
    return read_info(output)


def _same(found: dict[str, Any], source: Path | str, config: MapConfig) -> bool:
    """Whether the map with `found` in its map.json is of this input and these settings."""
    theirs = MapConfig.model_validate(found["config"])
    return found["source"] == str(source) and fingerprint(Path(), theirs) == fingerprint(Path(), config)
