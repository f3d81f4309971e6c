"""`perception bench section FOLDER... --into README.md`: "Speed against error", written from what benches measured.

Reads every rasterizer.json and map.json in the folders, and puts two tables between the section's markers in the given
file (or prints them). Plots are copied beside the file, into docs/, under the bench's and the scene's name.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.io.atomic import atomic_file

BEGIN, END = "<!-- speed against error: begin -->", "<!-- speed against error: end -->"
READ = ("rasterizer", "map")


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="perception bench section", description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="where benches left their JSON (-o)")
    parser.add_argument("--into", type=Path, metavar="FILE.md", help="a file with the section's markers")
    options = parser.parse_args(arguments)
    reports = [report for folder in options.folders for report in _reports(folder)]
    text = section(reports)
    if options.into is None:
        print(text)
        return
    put(options.into, text)
    for report in reports:
        _copy_plot(report, options.into.parent / "docs")
    print(f"{options.into}: written from {len(reports)} benches", file=sys.stderr)


def section(reports: Sequence[dict[str, Any]]) -> str:
    """The section's text. reports: what the benches keep as JSON."""
    by_name = {name: [r for r in reports if r["bench"] == name] for name in READ}
    parts = [_rasterizer(r) for r in by_name["rasterizer"]] + ([_mapping(by_name["map"])] if by_name["map"] else [])
    return "\n\n".join(parts)


def put(path: Path, text: str) -> None:
    """Replaces what stands between the markers. InputError where there are none."""
    whole = path.read_text(encoding="utf-8") if path.is_file() else ""
    if whole.count(BEGIN) != 1 or whole.count(END) != 1 or whole.index(BEGIN) > whole.index(END):
        raise InputError(f"{path}: found no place for the section, expected the lines '{BEGIN}' and '{END}' once each")
    before, rest = whole.split(BEGIN)
    with atomic_file(path) as aside:
        aside.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}", encoding="utf-8")


def _reports(folder: Path) -> list[dict[str, Any]]:
    found = [folder / f"{name}.json" for name in READ if (folder / f"{name}.json").is_file()]
    if not found:
        raise InputError(f"{folder}: found no {' or '.join(f'{n}.json' for n in READ)}; give a bench's -o folder")
    try:
        reports = [json.loads(path.read_text(encoding="utf-8")) | {"folder": folder} for path in found]
        if all({"bench", "rows", "machine", "arguments"} <= report.keys() for report in reports):
            return reports
    except (json.JSONDecodeError, TypeError):
        pass
    raise InputError(f"{folder}: found JSON that no bench of this version wrote; run the bench again")


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [heads, ["---"] * len(heads), *rows])


def _machine(report: dict[str, Any]) -> str:
    machine = report["machine"]
    return f"{machine['processor']}, {machine['cores']} cores, {machine['serial_add_ns']:.1f} ns a dependent addition"


def _rasterizer(report: dict[str, Any]) -> str:
    heads = ["scene", "level", "precision", "channels", "ms, 1 thread", "ns a pair", "times plain code", "threads gain"]
    heads += ["error p99.9", "mean", "gradients"]
    rows = []
    for row in report["rows"]:
        if row["threads"] != 1 or (row["dtype"], row["simd"]) == ("float64", "baseline"):
            continue
        same = [r for r in report["rows"] if all(r[k] == row[k] for k in ("scene", "simd", "dtype", "channels"))]
        most = max(same, key=lambda r: r["threads"])
        cells = [row["scene"], row["simd"], row["dtype"], row["channels"], f"{row['median_ms']:.0f}"]
        cells += [f"{row['ns_per_pair']:.1f}", _times(row["times_baseline"])]
        cells += [f"{_times(most['times_one_thread'])} ({most['threads']})"]
        cells += [f"{row[key]:.0e}" for key in ("error_p999", "error_mean", "gradient_error")]
        rows.append(cells)
    return (
        f"**Rasterizer**, forward and backward to the 3D parameters (`perception bench rasterizer SPLATS.npz`; "
        f"{_machine(report)}; median of {report['arguments']['rounds']} interleaved rounds, CPU nanoseconds a "
        f"contributing pair, error of pictures and gradients to the float64 build):\n\n{_table(heads, rows)}"
    )


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}×"


def _mapping(reports: Sequence[dict[str, Any]]) -> str:
    heads = ("scene", "setting", "CPU minutes", "PSNR", "SSIM", "AP", "Gaussians", "best for its time in")
    rows = []
    for report in reports:
        native = report["rows"][0]["pixels"]
        for row in report["rows"]:
            if row["group"] != "preset" and (not row["front"] or row["pixels"] != native):
                continue  # every preset, and of the rest what nothing beats
            cells = [report["scene"], f"{row['group']} {row['name']}", f"{row['cpu_minutes']:.2f}"]
            cells += ["-" if row.get(k) is None else format(row[k], f) for k, f in (("psnr", ".2f"), ("ssim", ".3f"))]
            cells += [
                "-" if row.get("ap") is None else f"{row['ap']:.2f}",
                f"{row['gaussians']:,}",
                row["front"] or "-",
            ]
            rows.append(cells)
    schedules = ", ".join(map(_schedule, reports))
    links = ", ".join(f"[{report['scene']}](docs/{_plot_name(report)})" for report in reports)
    return (
        f"**Mapping**, the presets and whatever else lies on the front of time against quality (`perception bench map "
        f"SCENE`; {schedules}; {_machine(reports[0])}; all points: {links}):\n\n{_table(heads, rows)}"
    )


def _schedule(report: dict[str, Any]) -> str:
    given = report["arguments"]
    if given.get("quick"):
        return f"{report['scene']} `--quick`: a sixth of the iterations, 320 pixels, 20,000 Gaussians"
    if given.get("shorten"):
        return f"{report['scene']} `--shorten {given['shorten']:g}`: so many times fewer iterations"
    return f"{report['scene']} in full"


def _plot_name(report: dict[str, Any]) -> str:
    return f"bench-{report['bench']}-{report['scene']}.png" if "scene" in report else f"bench-{report['bench']}.png"


def _copy_plot(report: dict[str, Any], docs: Path) -> None:
    plot = report["folder"] / f"{report['bench']}.png"
    if plot.is_file() and docs.is_dir():
        shutil.copyfile(plot, docs / _plot_name(report))
