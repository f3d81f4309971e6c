"""What tasks ask of the machines of a Ray cluster."""

from __future__ import annotations

import tempfile

import pytest

from perception.progress import Progress
from perception.tasks.engine import Engine

pytest.importorskip("ray")


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
