"""Maps from photos in an object store, and into one: the local paths between which `build_map` works."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.config import MapConfig
from perception.errors import InputError
from perception.io.object_store import fetch, is_url, publish, published
from perception.map.files import read_info
from perception.onnx.store import cache_folder
from perception.pipeline.checkpoint import digest, fingerprint
from perception.progress import Progress
from perception.report.page import write_own_report


@dataclass
class Places:
    """Arguments of `build_map`; info: the content of map.json once the map is whole, None while it must be built."""

    source: Path
    output: Path
    resume: bool
    origin: str
    info: dict[str, Any] | None = None


@contextmanager
def local_places(
    source: Path | str, output: Path | str, config: MapConfig, resume: bool, progress: Progress
) -> Iterator[Places]:
    """Where the block finds its input and writes its map, which then gets its report and goes where it belongs.

    Photos at a URL are copied to the folder NAME.input beside the map, which needs them. A map for a URL is made in the
    cache, and removed there once it is in the store. InputError for stores that cannot be read or written.
    """
    if not is_url(output):
        with _reported(source, Path(output), resume, progress) as places:
            yield places
        return
    url = str(output)
    found = published(url)
    if found is not None:
        if not resume or not _same(found, source, config):
            raise InputError(f"{url}: exists already; choose another -o or remove it first")
        progress.log(f"{url}: this run is finished")
        yield Places(Path(), Path(), resume, str(source), found)
        return
    stage = cache_folder() / "unpublished" / digest(url)
    local = stage / url.rstrip("/").rpartition("/")[2]
    with _reported(source, local, resume or local.exists(), progress) as places:
        yield places
    publish(local, url, progress)
    shutil.rmtree(stage)
    progress.log(f"{url}: written")


@contextmanager
def _reported(source: Path | str, output: Path, resume: bool, progress: Progress) -> Iterator[Places]:
    photos = fetch(str(source), output.with_suffix(".input"), progress) if is_url(source) else Path(source)
    places = Places(photos, output, resume, str(source))
    yield places
    write_own_report(output, progress)
    places.info = read_info(output)


def _same(found: dict[str, Any], source: Path | str, config: MapConfig) -> bool:
    """Whether the map with `found` in its map.json is of this input and these settings."""
    try:
        theirs = MapConfig.model_validate(found["config"])
    except ValueError:  # settings of another version
        return False
    return found["source"] == str(source) and fingerprint(Path(), theirs) == fingerprint(Path(), config)
