"""A launch file (YAML) as typed settings, and as the commands they amount to."""

from __future__ import annotations

import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from perception.config import PRESETS, MapConfig, Settings, flat, settings_from
from perception.errors import InputError
from perception.node.config import NodeConfig


class MapperPart(Settings):
    """`perception map`: input and output paths, a preset, any of its settings; again: although the map is there."""

    input: str = ""
    output: str = ""
    preset: str = "default"
    again: bool = False
    settings: dict[str, Any] = Field({})


class NodePart(Settings):
    """`perception node`: the map, default what the mapper makes, and its settings."""

    map: str = ""
    settings: dict[str, Any] = Field({})


class ViewerPart(Settings):
    """`perception view`: the map, default what the mapper makes, and where its page is."""

    map: str = ""
    host: str = "127.0.0.1"
    port: int = Field(8090, ge=0, le=65535)


PARTS: dict[str, type[MapperPart] | type[NodePart] | type[ViewerPart]] = {
    "mapper": MapperPart,
    "node": NodePart,
    "viewer": ViewerPart,
}


@dataclass(frozen=True)
class Job:
    """One process. needs: the map that must be there before it starts. once: it is to end by itself."""

    name: str
    command: tuple[str, ...]
    needs: Path | None = None
    once: bool = False

    def to_json(self) -> dict[str, Any]:
        needs = None if self.needs is None else str(self.needs)
        return {"name": self.name, "command": list(self.command), "needs": needs, "once": self.once}


def read_plan(file: Path, only: Collection[str] = ()) -> list[Job]:
    """The processes of a launch file, those named in `only` if any are. Paths in it are relative to its folder.

    InputError names the file and the setting that is wrong.
    """
    for name in only:
        if name not in PARTS:
            raise InputError(f"--only: found '{name}', expected one of: {', '.join(PARTS)}")
    document = _read_yaml(file)
    for name in document:
        if name not in PARTS:
            raise InputError(f"{file}: unknown part '{name}', expected one of: {', '.join(PARTS)}")
    known = {name: _read_part(name, document[name], str(file)) for name in PARTS if name in document}
    chosen = {name: part for name, part in known.items() if not only or name in only}
    if not chosen:
        raise InputError(f"{file}: starts nothing; give one of: {', '.join(PARTS)}")
    mapper = known.get("mapper")
    made = _path(file, mapper.output) if isinstance(mapper, MapperPart) and mapper.output else None
    return [_job(name, part, file, made) for name, part in chosen.items() if not _done(part, file)]


def _read_yaml(file: Path) -> dict[str, Any]:
    import yaml

    try:
        document = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); give an existing YAML file") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not valid YAML ({error})") from error
    if not isinstance(document, dict):
        raise InputError(f"{file}: found {type(document).__name__}, expected parts: {', '.join(PARTS)}")
    return document


def _read_part(name: str, values: Any, where: str) -> Any:
    """A part's settings, checked as its command checks them."""
    values = dict(_mapping(values, where, name))
    if "settings" in values and "settings" not in PARTS[name].model_fields:
        raise InputError(f"{where}: {name} has no 'settings', expected {', '.join(PARTS[name].model_fields)}")
    inner = dict(flat(_mapping(values.pop("settings", None), where, f"{name}.settings")))
    part: Any = settings_from(PARTS[name], {key: (value, f"{where}: {name}") for key, value in values.items()})
    model: Any = {"mapper": MapConfig, "node": NodeConfig}.get(name)
    if model is not None:
        settings_from(model, {key: (value, f"{where}: {name}.settings") for key, value in inner.items()})
        part = part.model_copy(update={"settings": inner})
    if isinstance(part, MapperPart) and part.preset not in PRESETS:
        raise InputError(f"{where}: mapper.preset: found {part.preset!r}, expected one of: {', '.join(PRESETS)}")
    return part


def _mapping(value: Any, where: str, name: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f"{where}: {name}: found {type(value).__name__}, expected settings by name")
    return value


def _path(file: Path, text: str) -> Path:
    return file.resolve().parent / Path(text).expanduser()


def _done(part: Any, file: Path) -> bool:
    """A mapper whose map is there has nothing to do."""
    if not isinstance(part, MapperPart) or part.again or not part.output:
        return False
    return (_path(file, part.output) / "map.json").is_file()


def _job(name: str, part: Any, file: Path, made: Path | None) -> Job:
    run = (sys.executable, "-m", "perception.cli")
    if isinstance(part, MapperPart):
        if not part.input or not part.output:
            raise InputError(f"{file}: mapper: input and output are needed")
        paths = (str(_path(file, part.input)), "-o", str(_path(file, part.output)))
        return Job(name, (*run, "map", *paths, "--preset", part.preset, "--resume", *_pairs(part.settings)), once=True)
    held = _path(file, part.map) if part.map else made
    if held is None:
        raise InputError(f"{file}: {name}: no map given, and no mapper that makes one")
    if isinstance(part, NodePart):
        return Job(name, (*run, "node", str(held), *_pairs(part.settings)), held)
    return Job(name, (*run, "view", str(held), "--host", part.host, "--port", str(part.port)), held)


def _pairs(settings: dict[str, Any]) -> list[str]:
    """`--set KEY=VALUE` for each setting."""
    texts = {True: "true", False: "false", None: "none"}
    return [
        word
        for key, value in settings.items()
        for word in ("--set", f"{key}={texts[value] if value is None or isinstance(value, bool) else value}")
    ]
