"""Many maps from one list of jobs: `perception fleet JOBS.yaml`, here or on a Ray cluster."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from perception.config import MapConfig, Settings, load_config, settings_from
from perception.errors import InputError, local_path, refuse_named_pipe
from perception.io.documents import brief, read_yaml
from perception.pipeline.mapping import build_map
from perception.progress import QUIET, Progress
from perception.report.page import write_own_report
from perception.tasks.engine import Engine

_WORDS = {"None": "none", "True": "on", "False": "off"}  # values of YAML in the words of settings


class Job(Settings):
    """One map: its input, output and settings as `perception map` has them; all paths are relative to the list."""

    input: str
    output: str
    preset: str = "default"
    config: str | None = None
    set: dict[Any, Any] = Field(default_factory=dict)


def run_fleet(file: Path, engine: Engine, progress: Progress) -> list[dict[str, Any]]:
    """Makes the maps of all jobs; {input, output, seconds or error} of each. A finished map is not made again, an
    unfinished one goes on. InputError before any work for a list that cannot be read or has a wrong job."""
    tasks = [json.dumps(job) for job in read_jobs(file)]
    return list(engine.run(map_one, tasks, "map", progress))


def read_jobs(file: Path) -> list[dict[str, Any]]:
    """The checked jobs of a YAML list of {input, output, preset, config, set: {KEY: VALUE}}, with absolute paths."""
    refuse_named_pipe(file)
    expected = "a list of jobs, '- input: PHOTOS' and 'output: MAP.gsmap' each"
    listed = read_yaml(file, expected)
    if not isinstance(listed, list) or not listed:
        raise InputError(f"{file}: expected {expected}")
    jobs, outputs = list[dict[str, Any]](), dict[tuple[int, int, str], dict[str, int]]()
    for number, entry in enumerate(listed, start=1):
        where = f"{file}, job {number}"
        if not isinstance(entry, dict) or not isinstance(entry.get("set", {}), Mapping):
            raise InputError(
                f"{where}: expected 'input: PHOTOS' and 'output: MAP.gsmap', and maybe 'set: {{KEY: VALUE}}'"
            )
        given = {str(key): (value, where) for key, value in entry.items()}
        for key in ("input", "output"):
            if key not in given:
                raise InputError(f"{where}: has no {key}")
        job = settings_from(Job, given)
        pairs = [f"{key}={_WORDS.get(str(value), value)}" for key, value in job.set.items()]
        try:
            paths = (file.parent / local_path(text) for text in (job.input, job.output))
            source, output = (Path(os.path.realpath(path)) for path in paths)
            settings = file.parent / local_path(job.config) if job.config else None
        except ValueError as error:  # characters that no path can have, and URLs
            raise InputError(f"{where}: {error}") from error
        if not os.path.exists(source):  # noqa: PTH110 - Path.exists raises for a long name
            raise InputError(f"{where}: {source} does not exist")
        # One folder has one inode, whatever its spelling or mount. Names that differ in case may be one name there.
        above = next(path for path in (output, *output.parents) if os.path.exists(path))  # noqa: PTH110
        name = output.relative_to(above).as_posix()
        known = outputs.setdefault((above.stat().st_dev, above.stat().st_ino, name.casefold()), {})
        if other := known.get(name) or next((known[one] for one in known if _ignores_case(above)), None):
            raise InputError(f"{where}: has the output of job {other}, {output}")
        known[name] = number
        try:
            config = load_config(settings, pairs, job.preset, folder=file.parent)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        jobs.append({"input": str(source), "output": str(output), "settings": config.to_json()})
    return jobs


def _ignores_case(folder: Path) -> bool:
    try:
        with tempfile.TemporaryDirectory(dir=folder) as probe:
            (Path(probe) / "a").touch()
            return (Path(probe) / "A").exists()
    except OSError:  # no map can be written there
        return False


def map_one(task: str, progress: Progress = QUIET) -> dict[str, Any]:
    """Makes the map of one job. An error of any class is in its result, so that the other maps are made."""
    job = json.loads(task)
    row = {"input": job["input"], "output": job["output"]}
    try:
        config = MapConfig.model_validate(job["settings"])
        build_map(Path(job["input"]), Path(job["output"]), config, resume=True, progress=progress)
        info = write_own_report(Path(job["output"]), progress)
        return {**row, "seconds": info["seconds"]["total"], "instances": info["num_instances"]}
    except InputError as error:
        return {**row, "error": " ".join(str(error).split())}
    except Exception as error:
        return {**row, "error": f"{type(error).__name__}: {brief(error, 400)}"}
