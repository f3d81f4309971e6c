"""Output of `perception map`, `info` and `query`: JSON, text, and the points of query hits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.errors import shell_word, visible
from perception.map.checksums import IGNORED
from perception.map.history import STATES, Visit, changes_of, date_of, is_removed, visits_of

if TYPE_CHECKING:
    from perception.query import Hit, QueryMap


def map_facts(path: Path | str, info: dict[str, Any]) -> dict[str, Any]:
    """The JSON output of `perception map`; info: content of map.json."""
    training = info["training"]
    return {
        "map": str(path),
        "gaussians": info["num_gaussians"],
        "instances": info["num_instances"],
        **{key: info[key] for key in ("quality", "seconds", "peak_memory_mib", "scene")},
        **{key: training[key] for key in ("iterations", "decisions")},
        "profile": shares(training),
    }


def shares(training: dict[str, Any]) -> dict[str, float]:
    """Share of the training time of each part, largest first; "other" is the unattributed rest."""
    total, parts = max(training.get("seconds", 0.0), 1e-9), training.get("profile", {})
    parts = {**parts, "other": max(0.0, total - sum(parts.values()))}
    return {name: round(seconds / total, 4) for name, seconds in sorted(parts.items(), key=lambda part: -part[1])}


CHANGED = STATES[:3]  # the states of things that are not as they were
SHARP, BLURRED = 25.0, 20.0  # held-out PSNR in dB from which a map is called sharp, and below which poor


def info_text(path: Path, info: dict[str, Any], entries: Sequence[dict[str, Any]] = ()) -> str:
    """Summary of map.json as text, for `perception info`: what the map is, how good it is, what to do next, then its
    details. entries: those of instances.json."""
    quality, training, scene = info.get("quality", {}), info.get("training", {}), info.get("scene", {})
    seconds, trained = info.get("seconds", {}), max(training.get("seconds", 0.0), 1e-9)
    left_out = [f"left out: {entry['name']} ({entry['why']})" for entry in scene.get("left_out", [])]
    warnings = [f"warning: {text}" for text in scene.get("warnings", [])]
    count = info["num_instances"] - sum(map(is_removed, entries))
    unit = "in metres" if info.get("metric") else "without a metric scale"
    visits = info.get("visits")
    made = f"updated from {visits[-1]['input']}" if visits else f"made from {info.get('source')}"
    lines = [
        f"{path}: {count} instances in {info['num_gaussians']:,} Gaussians, "
        f"from {len(info.get('views', []))} photos, {unit}",
        _verdict(quality, len(left_out), len(warnings)),
        "next: " + _next_step(path, info),
        f"{made} (seed {info.get('seed')}) in {seconds.get('total', 0):.0f} s: "
        + ", ".join(f"{name} {value:.0f}" for name, value in seconds.items() if name != "total"),
        f"trained {training.get('iterations')} iterations ({training.get('pairs', 0) / trained / 1e6:.1f} M pairs/s), "
        f"harmonics of degree {info['sh_degree']}; peak memory {info.get('peak_memory_mib')} MiB",
    ]
    lines += frame_lines(info)
    if still := scene.get("still"):
        what = f"{still['share']:.1%} of the pixels of {still['photos']} photos"
        lines.append(f"ignored, as it stays in the picture while the camera moves: {what} ({path / IGNORED})")
    if visits:
        dates, newest = visits_of(info), len(visits) - 1
        states = state_counts(changes_of(dates, list(entries), max(newest - 1, 0)))
        more = f"perception changes {shell_word(path)}"
        lines.append(f"visits: {len(visits)}, the newest on {date_of(dates, newest)} ({states}); {more}")
    if training.get("profile"):
        lines.append("of training: " + ", ".join(f"{name} {share:.0%}" for name, share in shares(training).items()))
    if depth := info.get("depth"):
        lines.append(f"depth images: {depth['views']}, measured in {depth['measured']:.0%} of their pixels")
    if printed := [e for e in entries if e.get("texts") and not is_removed(e)]:
        from perception.query.hit import printed_texts

        lines += [f"printed on {e['id']}: {visible(', '.join(printed_texts(e)))}" for e in printed]
    lines += [f"decision: {text}" for text in training.get("decisions", [])]
    return "\n".join([*lines, *left_out, *warnings])


def _verdict(quality: dict[str, Any], left_out: int, warnings: int) -> str:
    """The quality of the map in one line."""
    if quality.get("psnr") is None:
        parts = ["not measured, as no photo was held out"]
    else:
        psnr = quality["psnr"]
        grade = "sharp" if psnr >= SHARP else "blurred in places" if psnr >= BLURRED else "poor"
        parts = [f"{grade}: PSNR {psnr:.2f} dB, SSIM {quality['ssim']:.3f}, held-out photos: {len(quality['views'])}"]
    if quality.get("depth"):
        parts.append(depth_text(quality["depth"]))
    parts += [f"{what}: {count}" for what, count in (("photos left out", left_out), ("warnings", warnings)) if count]
    return "quality: " + ", ".join(parts)


def _next_step(path: Path, info: dict[str, Any]) -> str:
    """The command that helps most."""
    if not info["num_instances"]:
        return "no instance was found; give masks (perception map --masks) or more photos"
    name = shell_word(path)
    if info.get("instances", {}).get("encoder", "") is None:
        use = f"perception view {name} to name things: it was mapped without an encoder, and knows no other words"
    else:
        use = f'perception query {name} "mug", or perception view {name}'
    scale = f'perception scale {name} --known-length "METRES: ID, ID" for metres; '
    return use if info.get("metric") else scale + use


def frame_lines(info: dict[str, Any]) -> list[str]:
    """What is known of a map's frame, one line each: unit, gravity, place in the input's frame; info: map.json."""
    lines, scale, gravity = [], info.get("scale"), info.get("gravity")
    if scale:
        unit = "1" if info.get("metric") else f"{scale['metres_per_unit']:.4g}"
        error = "" if scale["standard_error"] is None else f" ± {scale['standard_error']:.2g} m"
        lines.append(f"scale: a unit is {unit} m{error}, by {scale['source']}")
    if gravity:
        down = ", ".join(f"{x:.3f}" for x in gravity["direction"])
        lines.append(f"gravity: down is {down} ± {gravity['standard_error_deg']:.1f}°, by {gravity['source']}")
    if "map_from_input" in info:
        origin = np.linalg.inv(info["map_from_input"])[:3, 3]
        lines.append(f"the map's origin lies at {origin.round(6).tolist()} of its input")
    return lines


def depth_figures(errors: dict[str, Any]) -> tuple[str, str, str]:
    """Of `depth_errors`: the median error, the share of pixels within the tolerance, and the tolerance."""
    unit = "cm" if errors["unit"] == "m" else "%"
    return f"{100 * errors['median']:.2g} {unit}", f"{errors['close']:.0%}", f"{100 * errors['tolerance']:.2g} {unit}"


def depth_text(errors: dict[str, Any]) -> str:
    """`depth_errors` as a phrase."""
    median, share, tolerance = depth_figures(errors)
    return f"depth error {median} in the median, {share} within {tolerance}"


def query_text(
    answers: Sequence[tuple[str, list[Hit], list[Hit]]],
    metric: bool | None,
    names: Mapping[int, str] | None = None,
    visits: Sequence[Visit] = (),
) -> str:
    """Ranked hits of each prompt in aligned columns, or "not present", and what answers it and is gone. metric: whether
    positions are in metres. names: of `names_of`."""
    lines, names = list[str](), names or {}
    for text, hits, gone in answers:
        lines.append(f'"{text}": {f"{len(hits)} found" if hits else "not present"}')
        rows = [_hit_row(f"{rank}.", hit, metric, names, visits) for rank, hit in enumerate(hits, start=1)]
        lines += _aligned(rows + [_hit_row("gone:", hit, metric, names, visits) for hit in gone])
    return "\n".join(lines)


def _aligned(rows: list[list[str]]) -> list[str]:
    """Rows of cells as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def names_of(opened: QueryMap) -> dict[int, str]:
    """Instance id -> the label that the user gave it, else with an encoder its likeliest name, called guessed; also of
    what is gone."""
    known = opened.last_known
    likely = [[] for _ in known.instances] if known.problem is not None else known.likely_names(1)
    guessed = {int(e["id"]): f"{names[0]} (guessed)" for e, names in zip(known.instances, likely, strict=True) if names}
    return guessed | {int(entry["id"]): entry["label"] for entry in known.instances if entry.get("label")}


def _name(instance_id: int, label: str | None, names: Mapping[int, str]) -> str:
    return visible(label or names.get(instance_id, "no name"))


def _position(point: Sequence[float] | np.ndarray, metric: bool | None) -> str:
    x, y, z = point
    return f"{x:.2f} {y:.2f} {z:.2f} m" if metric else f"{x:.3f} {y:.3f} {z:.3f}"


def _hit_row(rank: str, hit: Hit, metric: bool | None, names: Mapping[int, str], visits: Sequence[Visit]) -> list[str]:
    """Rank, name, score, position, size, id and visits of a hit, as the cells of a row."""
    in_metres = metric if hit.metric is None else hit.metric
    name = _name(hit.instance_id, hit.label, names)
    scale, unit = (100.0, " cm") if in_metres else (1.0, "")
    sides = " x ".join(f"{scale * side:.{0 if in_metres else 3}f}" for side in hit.obb.extent)
    ident = f"instance {hit.instance_id}"
    ident += "" if hit.part is None else f", part {hit.part}"
    ident += f", together {', '.join(map(str, hit.instances))}" if hit.instances else ""
    ident += "" if hit.map is None else f" in {hit.map}"
    history = [] if hit.state is None or not visits else _history(hit, in_metres, names, visits)
    position = f"{'stood' if hit.state == 'removed' else 'at'} {_position(hit.centroid, in_metres)}"
    return [rank, name, f"score {hit.score:.2f}", position, f"size {sides}{unit}", ident, "; ".join(history)]


def _history(hit: Hit, metric: bool | None, names: Mapping[int, str], visits: Sequence[Visit]) -> list[str]:
    """What the visits record of a hit: since when it is there or gone, where it was, when it was seen last."""
    since, newest, phrases = date_of(visits, hit.since or 0), len(visits) - 1, []
    if hit.state == "removed":
        phrases.append(f"gone since {since}")
        if hit.stood is not None:
            relation, other = hit.stood
            phrases[-1] += f", stood {relation} {_name(other, None, names)} (instance {other})"
    elif hit.was is not None:
        phrases.append(f"here since {since}, before at {_position(hit.was, metric)}")
    elif hit.state == "added":
        phrases.append(f"new on {since}")
    if hit.last_seen is not None and hit.last_seen < newest:
        phrases.append(f"last seen {date_of(visits, hit.last_seen)}")
    return phrases


def state_counts(changes: Sequence[Mapping[str, Any]]) -> str:
    """How many things are in each state: "1 moved, 2 removed, 0 added, 9 unchanged, 3 not looked at"."""
    counts = Counter(change["state"] for change in changes)
    return ", ".join(f"{counts[state]} {state.replace('unseen', 'not looked at')}" for state in STATES)


def changes_text(opened: QueryMap, since: int, names: Mapping[int, str]) -> str:
    """What changed since a visit, as a table, and what nobody looked at."""
    if len(opened.visits) == 1:
        return f"{opened.path}: has one visit, so nothing is known to have changed; perception update adds another"
    title, rows, rest = changes_parts(opened, since, names)
    return "\n".join([f"{opened.path}: {title}", *_aligned([row for _, row in rows]), *rest])


def changes_parts(
    opened: QueryMap, since: int, names: Mapping[int, str]
) -> tuple[str, list[tuple[dict[str, Any], list[str]]], list[str]]:
    """Dates and counts; each change with its cells; and lines with what nobody looked at and what is as it was."""
    changes, visits = opened.changes(since), opened.visits
    title = f"{date_of(visits, len(visits) - 1)} against {date_of(visits, since)}: {state_counts(changes)}"
    rows = [(c, _change_row(c, opened.metric, names, visits)) for c in changes if c["state"] in CHANGED]
    lines = []
    for state, heading in (("unseen", "not looked at"), ("unchanged", "unchanged")):
        rest = [c for c in changes if c["state"] == state]
        named = [f"{_name(c['instance_id'], c['label'], names)} [{c['instance_id']}]" for c in rest]
        seen = [f", last seen {date_of(visits, c['last_seen'])}" if state == "unseen" else "" for c in rest]
        lines += [f"{heading}: " + "; ".join(map(str.__add__, named, seen))] if rest else []
    return title, rows, lines


def _change_row(
    change: Mapping[str, Any], metric: bool | None, names: Mapping[int, str], visits: Sequence[Visit]
) -> list[str]:
    """State, name, id, confidence, positions and dates of a change, as the cells of a row."""
    old, new, number = change["old_centroid"], change["new_centroid"], change["instance_id"]
    parts = [f"{'from' if new else 'stood at'} {_position(old, metric)}"] if old else []
    parts += [f"to {_position(new, metric)}"] if old and new else [f"at {_position(new, metric)}"] if new else []
    if old and new:
        length = float(np.linalg.norm(np.subtract(new, old)))
        parts.append(f"by {100 * length:.0f} cm" if metric else f"by {length:.3f}")
    if change.get("axis") is not None:
        parts.append("looks round, so its turn is not known")
    elif change["transform"] is not None:
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_matrix(np.array(change["transform"])[:3, :3])
        parts.append(f"turned {np.degrees(rotation.magnitude()):.0f}°")
    if change["state"] == "removed":
        parts.append(f"last seen {date_of(visits, change['last_seen'])}")
    sure = "" if change["confidence"] is None else f"confidence {change['confidence']:.2f}"
    note = "cannot be told from another thing or motion" if change.get("ambiguous") else ""
    name = _name(number, change["label"], names)
    return [change["state"], name, f"instance {number}", sure, ", ".join(parts), note]


def write_hits(path: Path, hits: list[Hit]) -> None:
    """Writes the points of all hits as one cloud, with `instance_id` and the colours of the map."""
    from perception.io.cloud import write_cloud
    from perception.types import PointCloud

    hits = list({(hit.instance_id, hit.part, hit.instances): hit for hit in hits}.values())
    points = np.concatenate([np.zeros((0, 3), np.float32), *(hit.points for hit in hits)])
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(hit.colors() for hit in hits if hit.colors is not None)])
    ids = np.repeat(np.array([hit.instance_id for hit in hits], np.int32), [len(hit.points) for hit in hits])
    write_cloud(path, PointCloud(points, colors, labels={"instance_id": ids}))
