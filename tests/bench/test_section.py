"""The README's section from benches' JSON: what is written is what was read, and nothing else of the file changes."""

import json
from pathlib import Path

import pytest

from perception.bench import section
from perception.errors import InputError

MACHINE = {"processor": "test, avx2", "cores": 2, "serial_add_ns": 1.25}


def rasterizer_row(threads: int, faster: float) -> dict[str, object]:
    row = {"scene": "fox", "simd": "avx2", "dtype": "float32", "channels": "RGB", "threads": threads, "median_ms": 45.2}
    errors = {"error_p999": 4.9e-6, "error_mean": 6e-7, "gradient_error": 1.3e-3}
    return row | errors | {"ns_per_pair": 7.14, "times_baseline": 3.1, "times_one_thread": faster}


def map_row(group: str, name: str, minutes: float, front: str) -> dict[str, object]:
    row = {"group": group, "name": name, "cpu_minutes": minutes, "front": front, "pixels": 100, "gaussians": 20000}
    return row | {"psnr": 26.654, "ssim": 0.8804, "ap": None}


def write(folder: Path, bench: str, rows: list[dict[str, object]], **more: object) -> None:
    folder.mkdir(exist_ok=True)
    report = {"bench": bench, "rows": rows, "machine": MACHINE, "arguments": {"rounds": 7}, **more}
    (folder / f"{bench}.json").write_text(json.dumps(report))
    (folder / f"{bench}.png").write_bytes(b"plot")


def test_section_holds_what_was_read(tmp_path: Path) -> None:
    write(tmp_path / "a", "rasterizer", [rasterizer_row(1, 1.0), rasterizer_row(2, 1.73)])
    rows = [map_row("preset", "default", 0.5, ""), map_row("d", "4", 0.4, "psnr"), map_row("d", "16", 0.9, "")]
    write(tmp_path / "b", "map", rows, scene="fox_480")
    (tmp_path / "docs").mkdir()
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{section.BEGIN}\nold\n{section.END}\nafter\n")
    section.main([str(tmp_path / "a"), str(tmp_path / "b"), "--into", str(readme)])
    text = readme.read_text()
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    assert "| fox | avx2 | float32 | RGB | 45 | 7.1 | 3.1× | 1.7× (2) | 5e-06 | 6e-07 | 1e-03 |" in text
    assert "| fox_480 | preset default | 0.50 | 26.65 | 0.880 | - | 20,000 | - |" in text
    assert "| d 4 | " in text and "| d 16 | " not in text
    assert (tmp_path / "docs" / "bench-map-fox_480.png").read_bytes() == b"plot"
    section.main([str(tmp_path / "a"), str(tmp_path / "b"), "--into", str(readme)])
    assert readme.read_text() == text


def test_bad_input_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"found no rasterizer\.json or map\.json"):
        section.main([str(tmp_path)])
    (tmp_path / "map.json").write_text("{")
    with pytest.raises(InputError, match="no bench of this version"):
        section.main([str(tmp_path)])
    write(tmp_path, "map", [map_row("preset", "default", 0.5, "")], scene="s")
    (tmp_path / "x.md").write_text("no markers")
    with pytest.raises(InputError, match="no place for the section"):
        section.main([str(tmp_path), "--into", str(tmp_path / "x.md")])
