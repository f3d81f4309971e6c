"""Arrays read from files by several threads."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.io.arrays import map_npy, read_npz


def test_headers_are_read_by_one_thread_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In Python 3.11 `ast.literal_eval` of two threads at once may fail, and NumPy reads headers by it."""
    values = np.arange(12.0).reshape(3, 4)
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", values=values)
    real, inside, most, entered = np.lib.format.read_array_header_1_0, 0, 0, threading.Lock()

    def counted(stream: Any) -> Any:
        nonlocal inside, most
        with entered:
            inside += 1
            most = max(most, inside)
        time.sleep(0.01)
        found = real(stream)
        with entered:
            inside -= 1
        return found

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", counted)
    with ThreadPoolExecutor(4) as threads:
        mapped = [threads.submit(map_npy, tmp_path / "a.npy") for _ in range(8)]
        read = [threads.submit(read_npz, tmp_path / "a.npz", tmp_path / "a.npz", "") for _ in range(8)]
        found = [each.result() for each in mapped] + [each.result()["values"] for each in read]
    assert most == 1 and all(np.array_equal(each, values) for each in found)
