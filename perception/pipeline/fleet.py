"""Many maps from one list of jobs: `perception fleet JOBS.yaml`, here or on a Ray cluster."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from perception.config import MapConfig, Settings, load_config, settings_from
from perception.errors import InputError, refuse_named_pipe
from perception.io.object_store import is_url, place
from perception.pipeline.mapping import build_map
from perception.pipeline.remote import local_places
from perception.progress import QUIET, Progress
from perception.tasks.engine import Engine


class Job(Settings):
    """One map: its input and output, URLs or paths relative to the list; its settings as `perception map` has them."""

    input: str
    output: str
    preset: str = "default"
    config: str | None = None


def run_fleet(file: Path, engine: Engine, progress: Progress) -> list[dict[str, Any]]:
    """Makes the maps of all jobs; {input, output, seconds or error} of each. A finished map is not made again, an
    unfinished one goes on. InputError before any work for a list that cannot be read or has a wrong job."""
    tasks = [json.dumps(job) for job in read_jobs(file)]
    return list(engine.run(map_one, tasks, "map", progress))


def read_jobs(file: Path) -> list[dict[str, Any]]:
    """The checked jobs of a YAML list of {input, output, preset, config, set: {KEY: VALUE}}, with absolute paths."""
    import yaml

    refuse_named_pipe(file)
    try:
        listed = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{file}: cannot be read as YAML ({' '.join(str(error).split())})") from error
    if not isinstance(listed, list) or not listed:
        raise InputError(f"{file}: expected a list of jobs, '- input: PHOTOS' and 'output: MAP.gsmap' each")
    jobs, outputs = [], dict[str, int]()
    for number, entry in enumerate(listed, start=1):
        where = f"{file}, job {number}"
        if not isinstance(entry, dict) or not isinstance(entry.get("set", {}), Mapping):
            raise InputError(
                f"{where}: expected 'input: PHOTOS' and 'output: MAP.gsmap', and maybe 'set: {{KEY: VALUE}}'"
            )
        pairs = [f"{key}={value}" for key, value in entry.get("set", {}).items()]
        given = {key: (value, where) for key, value in entry.items() if key != "set"}
        for key in ("input", "output"):
            if key not in given:
                raise InputError(f"{where}: has no {key}")
        job = settings_from(Job, given)
        paths = {key: _place(getattr(job, key), file.parent) for key in ("input", "output")}
        if not is_url(paths["input"]) and not Path(paths["input"]).exists():
            raise InputError(f"{where}: {paths['input']} does not exist")
        if (other := outputs.setdefault(paths["output"], number)) != number:
            raise InputError(f"{where}: has the output of job {other}, {paths['output']}")
        config = load_config(file.parent / job.config if job.config else None, pairs, job.preset)
        jobs.append({**paths, "settings": config.to_json()})
    return jobs


def _place(text: str, folder: Path) -> str:
    return text if is_url(text) else str((folder / text).resolve())


def map_one(task: str, progress: Progress = QUIET) -> dict[str, Any]:
    """Makes the map of one job. An InputError is in its result, so that the other maps are made."""
    job = json.loads(task)
    told = {"input": job["input"], "output": job["output"]}
    try:
        config = MapConfig.model_validate(job["settings"])
        with local_places(place(job["input"]), place(job["output"]), config, True, progress) as at:
            if at.info is None:
                build_map(at.source, at.output, config, resume=at.resume, progress=progress, origin=at.origin)
    except InputError as error:
        return {**told, "error": " ".join(str(error).split())}
    assert at.info is not None
    return {**told, "seconds": at.info["seconds"]["total"], "instances": at.info["num_instances"]}
