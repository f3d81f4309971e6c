"""Opening ONNX models while a signal arrives."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from perception.errors import InputError
from perception.onnx.sessions import fingerprint, open_session, side_files

EXTENSION = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000): pass
except BaseException as error:  # what the import of a compiled module makes of it
    raise ImportError("initialization failed") from error
"""


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_during_the_import_is_no_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "onnxruntime.py").write_text(EXTENSION)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "onnxruntime", raising=False)
    try:
        with pytest.raises(KeyboardInterrupt):
            open_session(tmp_path / "model.onnx")
    finally:
        sys.modules.pop("onnxruntime", None)


def _write(path: Path, kind: int, location: str = "") -> None:
    """y = x * w in a type; location: the file that holds w."""
    import numpy as np

    from onnx import helper, numpy_helper, save_model

    w = numpy_helper.from_array(np.ones((64, 64), np.float64 if kind == 11 else np.float32), "w")
    x, y = (helper.make_tensor_value_info(name, kind, [1, 1, 64, 64]) for name in "xy")
    node = helper.make_node("AveragePool" if kind == 11 else "Mul", ["x"] if kind == 11 else ["x", "w"], ["y"])
    if kind == 11:
        node.attribute.append(helper.make_attribute("kernel_shape", [1, 1]))
    model = helper.make_model(
        helper.make_graph([node], "g", [x], [y], [w]), opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    )
    save_model(model, str(path), save_as_external_data=bool(location), location=location or None, size_threshold=1)


def test_weights_beside_the_graph_are_named_when_they_are_missing(tmp_path: Path) -> None:
    from perception.models import _local

    path, weights = tmp_path / "model.onnx", tmp_path / "weights_data.bin"
    _write(path, 1, weights.name)
    assert side_files(path) == [weights] and open_session(path).get_inputs()[0].name == "x"
    before = fingerprint(path)
    assert [name for name, _, _ in _local(str(path))] == [path.name, weights.name]
    weights.write_bytes(bytes(weights.stat().st_size))
    assert fingerprint(path) != before
    weights.unlink()
    with pytest.raises(InputError, match=r"its weights are in weights_data\.bin, not beside it; fetch that file too"):
        open_session(path)


def test_what_onnxruntime_cannot_run_is_told(tmp_path: Path) -> None:
    _write(tmp_path / "double.onnx", 11)
    with pytest.raises(InputError, match=r"lacks a kernel for it here.*AveragePool.*take full precision"):
        open_session(tmp_path / "double.onnx")
    (tmp_path / "pointer.onnx").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(InputError, match="a Git LFS pointer, not the model"):
        open_session(tmp_path / "pointer.onnx")
