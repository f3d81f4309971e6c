"""Opening ONNX models while a signal arrives."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from perception.io.onnx_sessions import open_session

EXTENSION = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000): pass
except BaseException as error:  # what the import of a compiled module makes of it
    raise ImportError("initialization failed") from error
"""


def test_ctrl_c_during_the_import_is_no_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "onnxruntime.py").write_text(EXTENSION)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "onnxruntime", raising=False)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores SIGINT
    try:
        with pytest.raises(KeyboardInterrupt):
            open_session(tmp_path / "model.onnx")
    finally:
        signal.signal(signal.SIGINT, before)
        sys.modules.pop("onnxruntime", None)
