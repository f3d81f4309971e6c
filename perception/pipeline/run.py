"""All that `perception map` leaves behind: the map and the report inside it."""

from __future__ import annotations

from pathlib import Path

from perception.config import MapConfig
from perception.errors import InputError
from perception.io.store import REPORT, Map
from perception.pipeline.mapping import build_map
from perception.pipeline.reporting import write_map_report
from perception.progress import Progress
from perception.query import load_map


def run_map(
    source: Path,
    output: Path,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress | None = None,
    labels_from: Path | None = None,
) -> Map:
    """`build_map`, then `report.html` inside the map."""
    progress = progress or Progress(quiet=True)
    gmap = build_map(source, output, config, resume=resume, progress=progress, labels_from=labels_from)
    try:
        write_map_report(load_map(output), output / REPORT, [])
    except InputError as error:  # the map is whole; its page can be made again with `perception report`
        progress.log(f"warning: no report: {error}")
    return gmap
