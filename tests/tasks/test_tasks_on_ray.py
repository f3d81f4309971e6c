"""What tasks ask of the machines of a Ray cluster."""

from __future__ import annotations

import os
import socket
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from perception.errors import InputError
from perception.progress import QUIET, Progress
from perception.tasks.engine import Engine

pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")


@pytest.mark.slow
def test_a_task_has_a_machine_of_its_own_or_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a cluster whose head takes no tasks, as large ones have it; Ray tells what a task was given."""
    from ray.cluster_utils import Cluster

    def given(_: str) -> float:  # runs in the worker, which cannot import this module
        import ray

        return float(ray.get_runtime_context().get_assigned_resources()["CPU"])

    with tempfile.TemporaryDirectory() as folder:  # the path of a socket may have 107 characters
        monkeypatch.setenv("RAY_TMPDIR", folder)
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        try:
            cluster.add_node(num_cpus=3)
            engine, shown = Engine("ray", cluster.address), Progress(quiet=True)
            assert engine.run(given, ["a", "b"], "task", shown) == [3.0, 3.0]
            assert engine.run(given, ["a", "b"], "task", shown, each_core=True) == [1.0, 1.0]
        finally:
            cluster.shutdown()


def test_a_cluster_of_another_version_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    def init(*_: object, **__: object) -> None:  # as ray._private.utils.check_version_info
        raise RuntimeError("Version mismatch: The cluster was started with:\n    Ray: 2.0\n    Python: 3.10.1\nThis")

    monkeypatch.setattr(ray, "init", init)
    with socket.create_server(("127.0.0.1", 0)) as server:
        engine = Engine("ray", f"127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(InputError, match=r"no Ray cluster there \(Version mismatch: .* Ray: 2\.0 Python: 3\.10\.1"):
            engine.run(print, ["a"], "task", QUIET)


@pytest.mark.parametrize(("token", "mode"), [(True, "token"), (False, None)])
def test_the_token_of_this_machine_is_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, token: bool, mode: str | None
) -> None:
    """`ray start --head` asks for it where there is one, and Ray 2.60 leaves one at every cluster of its own."""
    import ray

    def init(*_: object, **__: object) -> None:
        raise RuntimeError(f"mode {os.environ.get('RAY_AUTH_MODE')}")

    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.setenv(name, "")  # so that it is put back
        monkeypatch.delenv(name)
    if token:
        (tmp_path / ".ray").mkdir()
        (tmp_path / ".ray" / "auth_token").write_text("secret")
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.raises(InputError, match=f"mode {mode}"):
        Engine("ray", f"127.0.0.1:{server.getsockname()[1]}").run(print, ["a"], "task", QUIET)


@pytest.mark.slow
def test_a_cluster_started_here_hears_nobody_else_and_imports_nothing_of_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The kernel tells what the cluster's processes listen to; a module lies where everybody may write."""

    def seen(_: str) -> tuple[list[str], list[str], bool]:  # runs in the worker, which cannot import this module
        import sys
        from pathlib import Path

        def session(pid: str) -> int:
            return int(Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[3])

        sockets, own = set(), session("self")
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if session(folder.name) == own:
                    sockets |= {str(file.readlink()) for file in (folder / "fd").iterdir()}
            except OSError:  # a process or file that is gone
                continue
        lines = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()]
        heard = [line[1] for line in lines if line[3] == "0A" and f"socket:[{line[9]}]" in sockets]
        shared = [path for path in sys.path if Path(path).is_dir() and Path(path).stat().st_mode & 0o022]
        try:
            import everybodys  # type: ignore[import-not-found] # noqa: F401
        except ImportError:
            return heard, shared, False
        return heard, shared, True

    with tempfile.TemporaryDirectory() as shared:  # the path of a socket may have 107 characters
        Path(shared).chmod(0o1777)
        Path(shared, "everybodys.py").touch()
        with monkeypatch.context() as here:
            here.chdir(shared)
            here.setenv("TMPDIR", shared)
            here.setattr(tempfile, "tempdir", None)
            heard, writable, imported = Engine("ray").run(seen, ["a"], "task", Progress(quiet=True))[0]
            assert Path.cwd() == Path(shared).resolve()
    assert len(heard) > 3 and {line.rpartition(":")[0][-8:] for line in heard} == {"0100007F"}
    assert (writable, imported) == ([], False)
