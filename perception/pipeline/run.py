"""All that `perception map` leaves behind: the map, its report inside it, and a recording where one is asked for."""

from __future__ import annotations

import contextlib
from pathlib import Path

from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.train import Trainer
from perception.io.store import REPORT, GaussianMap
from perception.pipeline.mapping import build_map
from perception.pipeline.recording import Recording
from perception.pipeline.reporting import saved_views, write_map_report
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
    rrd: Path | None = None,
) -> GaussianMap:
    """`build_map`, then `report.html` inside the map; with `rrd` also a Rerun recording of the run.

    The recording begins where this call begins: a resumed run records what was left of it.
    """
    progress = progress or Progress(quiet=True)
    with Recording(rrd) if rrd is not None else contextlib.nullcontext() as recording:

        def note(trainer: Trainer) -> None:
            if recording is not None:
                arrays = {name: tensor.detach().numpy() for name, tensor in vars(trainer.gaussians).items()}
                recording.gaussians(trainer.iteration, arrays, trainer.record.curve[-1]["psnr"])

        gmap = build_map(
            source, output, config, resume=resume, progress=progress, labels_from=labels_from, on_note=note
        )
        if recording is not None:
            recording.cameras(saved_views(gmap))
            recording.instances(gmap)
    try:
        write_map_report(load_map(output), output / REPORT, [])
    except InputError as error:  # the map is whole; its page can be made again with `perception report`
        progress.log(f"warning: no report: {error}")
    return gmap
