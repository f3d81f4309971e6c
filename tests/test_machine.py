"""Cores and memory that control groups grant, versions 1 and 2, on folders as the kernel shows them; threads."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from perception import machine as module
from perception.errors import InputError

MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, dict[str, str]], None]:
    """Writes the process's own groups and files of groups, on a machine of 16 cores."""
    monkeypatch.setattr(module, "_CGROUPS", tmp_path)
    monkeypatch.setattr(module, "_OWN", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)

    def write(own: str, files: dict[str, str]) -> None:
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        (tmp_path / "own").write_text(own)

    return write


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),  # 1.5 cores are two threads
        ("0::/\n", {"cpu.max": "1000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 16),
        ("0::/\n", {"cpu.max": "9900000 100000\n"}, 16),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000\n", "a/b/cpu.max": "max 100000\n"}, 3),  # of the group above
        ("0::/not/shown/in/a/container\n", {"cpu.max": "50000 100000\n"}, 1),
        (
            "4:cpu,cpuacct:/x\n3:memory:/\n",
            {"cpu/cpu.cfs_quota_us": "250000\n", "cpu/cpu.cfs_period_us": "100000\n"},
            3,
        ),
        ("4:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 16),
        ("3:memory:/\n", {"cpu.max": "150000 100000\n"}, 16),
        ("0::/\n", {"cpu.max": "what\n"}, 16),
        ("", {}, 16),
    ],
)
def test_cores(groups: Callable, own: str, files: dict[str, str], expected: int) -> None:
    groups(own, files)
    assert module.cores() == expected


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"memory.max": "1000000\n"}, 1_000_000),
        ("0::/\n", {"memory.max": "max\n"}, MACHINE),
        ("0::/a/b\n", {"memory.max": "max\n", "a/memory.max": "2000000\n", "a/b/memory.max": "3000000\n"}, 2_000_000),
        ("0::/not/shown/in/a/container\n", {"memory.max": "1000000\n"}, 1_000_000),
        ("4:cpu:/\n3:memory:/x\n", {"memory/memory.limit_in_bytes": "1000000\n"}, 1_000_000),
        ("0::/\n", {"memory.max": f"{2 * MACHINE}\n"}, MACHINE),
        ("", {}, MACHINE),
    ],
)
def test_memory(groups: Callable, own: str, files: dict[str, str], expected: int) -> None:
    groups(own, files)
    assert module.memory_limit() == expected
    assert 0 < module.available_memory() <= expected
    with pytest.raises(InputError, match=r"cloud: needs about .* are free; split it"):
        module.require_memory(expected, "cloud", "split it")


@pytest.mark.parametrize(
    ("own", "at", "limit", "used", "prefix"),
    [
        ("0::/a/b\n", "a", "memory.max", "memory.current", ""),
        ("3:memory:/x\n", "memory/x", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
    ],
)
def test_memory_in_use_is_not_free_but_for_cached_files(
    groups: Callable, own: str, at: str, limit: str, used: str, prefix: str
) -> None:
    stat = f"anon 1\n{prefix}active_file 20000\n{prefix}inactive_file 30000\n"
    groups(own, {f"{at}/{limit}": "1000000\n", f"{at}/{used}": "700000\n", f"{at}/memory.stat": stat})
    assert module.available_memory() == 350_000 and module.memory_limit() == 1_000_000
    groups(own, {f"{at}/{used}": "1100000\n"})
    assert module.available_memory() == 0


def test_work_in_threads_comes_in_order_and_no_further_than_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Later items end first; none is begun while many results wait; the first error is raised and ends the rest."""
    monkeypatch.setattr(module, "cores", lambda: 3)
    begun, given = list[int](), list[int]()

    def work(item: int) -> int:
        begun.append(item)
        time.sleep(0.02 if item % 3 == 0 else 0)
        if item == 40:
            raise ValueError(str(item))
        return item * item

    def items() -> Iterator[int]:
        for item in range(60):
            given.append(item)
            yield item

    found = module.in_threads(work, items())
    assert [next(found) for _ in range(20)] == [n * n for n in range(20)]
    assert max(given) <= 24
    with pytest.raises(ValueError, match="40"):
        list(found)
    assert max(begun) <= 44
    assert list(module.in_threads(work, [])) == []


def test_products_have_the_same_bits_for_any_number_of_threads() -> None:
    """With two threads the nearest centres of a building's 790,456 Gaussians had other bits than with one, and a few of
    its instances differed."""
    rows = np.random.default_rng(0).normal(size=(2048, 11)).astype(np.float32)
    with threadpool_limits(1, "blas"):
        expected = rows @ rows.T
    with threadpool_limits(2, "blas"):
        with module.blas_on_one_thread():
            with module.blas_on_one_thread():
                pass
            assert np.array_equal(rows @ rows.T, expected)
        assert {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"} == {2}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no forks")
def test_a_forked_process_computes() -> None:
    code = (
        "import os, signal, torch, perception.machine\n"
        "double = lambda: (torch.ones(1 << 20) * 2).sum()\n"
        "torch.set_num_threads(2); double()\n"
        "if not (child := os.fork()):\n    signal.alarm(20); os._exit(int(double() != 2 << 20))\n"
        "assert os.waitpid(child, 0)[1] == 0 and torch.get_num_threads() == 2\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
