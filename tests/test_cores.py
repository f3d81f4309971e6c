"""CPU quotas of control groups, versions 1 and 2, on folders as the kernel shows them."""

import math
import os
from pathlib import Path

import pytest

from perception import cores as module

PERIOD = "cpu/cpu.cfs_period_us"  # of version 1


def quota(root: Path, own: str, files: dict[str, str]) -> float:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "own").write_text(own)
    return module._quota(root, root / "own")


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 1.5),
        ("0::/\n", {"cpu.max": "max 100000\n"}, math.inf),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000\n", "a/b/cpu.max": "max 100000\n"}, 3.0),  # of the group above
        ("0::/not/shown/in/a/container\n", {"cpu.max": "50000 100000\n"}, 0.5),
        (
            "4:cpu,cpuacct:/x\n3:memory:/\n",
            {"cpu/cpu.cfs_quota_us": "250000\n", "cpu/cpu.cfs_period_us": "100000\n"},
            2.5,
        ),
        ("4:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, math.inf),
        ("3:memory:/\n", {"cpu.max": "150000 100000\n"}, math.inf),
        ("0::/\n", {"cpu.max": "what\n"}, math.inf),
        ("", {}, math.inf),
    ],
)
def test_quotas(tmp_path: Path, own: str, files: dict[str, str], expected: float) -> None:
    assert quota(tmp_path, own, files) == expected


def test_threads_follow_the_quota(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quota of 1.5 cores is two threads on a machine of many, and one core stays one."""
    (tmp_path / "own").write_text("0::/\n")
    monkeypatch.setattr(module, "_CGROUPS", tmp_path)
    monkeypatch.setattr(module, "_OWN", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    for text, expected in (("150000 100000", 2), ("1000 100000", 1), ("max 100000", 16), ("9900000 100000", 16)):
        (tmp_path / "cpu.max").write_text(text)
        assert module.cores() == expected
