"""Where independent tasks run: on this machine, or on those of a Ray cluster."""

from __future__ import annotations

import logging
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.errors import InputError, home_path, missing_extra
from perception.io.documents import brief
from perception.machine import cores
from perception.progress import Progress

CONNECT = 10.0  # seconds in which a cluster must answer
RETRIES = 5  # how often a task is run again whose worker was lost
_TOKENS = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}
_CHILD = """import os, sys, threading, time
sys.path[:] = sys.argv[5:]
from importlib import import_module
from perception.errors import InputError
def leave():
    while os.getppid() == int(sys.argv[4]):
        time.sleep(0.5)
    os._exit(1)
threading.Thread(target=leave, daemon=True).start()
try:
    getattr(import_module(sys.argv[1]), sys.argv[2])(sys.argv[3])
except InputError as error:
    sys.exit(str(error))
"""


def _send_token() -> None:
    """Has Ray send the token of this machine, if there is one: clusters of Ray 2.60 ask for it. Call it before Ray is
    imported."""
    if _TOKENS & os.environ.keys() or home_path("~/.ray/auth_token").is_file():
        os.environ.setdefault("RAY_AUTH_MODE", "token")


def _join(ray: Any, address: str | None) -> None:
    """Connects this process to the cluster at `address`, or starts one, which no other machine reaches.

    Workers import from the driver's current folder first, which may be a clone without compiled core, or writable for
    others; so it is Python's own meanwhile. The sockets of a cluster that Ray starts listen on the loopback address
    where its clusters are of one machine, as by default on all systems but Linux.
    """
    options = {"ignore_reinit_error": True, "log_to_driver": False, "logging_level": logging.ERROR}
    before, constants = Path.cwd(), ray._private.ray_constants
    many = constants.ENABLE_RAY_CLUSTER
    os.chdir(sys.prefix)
    try:
        if address is not None:
            ray.init(address, **options)
            return
        constants.ENABLE_RAY_CLUSTER = False
        ray.init("local", include_dashboard=False, **options)  # without an address, it takes up what another run left
    finally:
        constants.ENABLE_RAY_CLUSTER = many
        os.chdir(before)


@dataclass(frozen=True)
class Engine:
    """kind: "local" or "ray". address: of a running Ray cluster ("auto": this machine's); None starts one here;
    InputError for one with "local".
    Tasks get and leave their data in folders that every worker reaches under the same path. The results do not depend
    on the kind and on the number of workers."""

    kind: str = "local"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.kind == "local" and self.address is not None:
            raise InputError(f"--address {self.address}: is of a Ray cluster; give --engine ray too, or leave it out")

    def run(
        self, task: Callable[..., Any], items: Sequence[str], what: str, progress: Progress, each_core: bool = False
    ) -> list[Any]:
        """task(item) of each item, in order; the first error is raised. what: a task's name in messages.
        A task must take up what an interrupted call has left. each_core: a task uses one core and shows its progress at
        least every few seconds, by which it is stopped here when the call is interrupted."""
        if self.kind == "ray":
            return self._on_ray(task, items, what, progress, each_core)
        if each_core:
            return _on_cores(task, items, what, progress)
        found = []
        for number, item in enumerate(items, start=1):
            progress.log(f"{what} {number} of {len(items)}")
            found.append(task(item, progress))
        return found

    def _on_ray(
        self, task: Callable[..., Any], items: Sequence[str], what: str, progress: Progress, each_core: bool
    ) -> list[Any]:
        _send_token()
        try:
            import ray
        except ImportError as error:
            raise missing_extra("ray", "ray") from error
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no statistics are sent
        started = not ray.is_initialized()
        try:
            if self.address not in (None, "auto"):  # Ray itself tries for seven minutes
                host, _, port = str(self.address).rpartition(":")
                socket.create_connection((host, int(port)), timeout=CONNECT).close()
            if started:
                _join(ray, self.address)
        except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: of another version
            here, there = "Ray cannot start a cluster here", f"--address {self.address}: no Ray cluster there"
            found = f"{here if self.address is None else there} ({brief(error, 300)})"
            raise InputError(f"{found}; start one: ray start --head, and give its --address HOST:PORT") from error
        try:
            host = ray.util.get_node_ip_address()
            if started and self.address is None and not host.startswith("127."):
                raise InputError(f"Ray {ray.__version__} listens on {host}, not on the loopback address; take another")
            # Where a task uses all cores of its machine, each machine has one task at a time.
            # A head of a cluster often has no CPU to give, and no entry then.
            offered = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
            taken = 1 if each_core else min(filter(None, offered), default=1)
            remote = ray.remote(task).options(num_cpus=taken, max_retries=RETRIES)
            submitted = [remote.remote(item) for item in items]
            waiting = submitted
            while waiting:
                done, waiting = ray.wait(waiting, num_returns=1)
                ray.get(done)
                progress.update(f"{what}s", len(items) - len(waiting), len(items))
            return list(ray.get(submitted))
        except ray.exceptions.RayTaskError as error:
            raise (error.cause if isinstance(error.cause, InputError) else error) from None
        except ray.exceptions.RayError as error:
            why = str(error).splitlines()[0]
            raise InputError(f"a worker was lost {RETRIES + 1} times ({why}); go on with --resume") from error
        finally:
            if started:
                ray.shutdown()


LOCAL = Engine()


class _Stoppable(Progress):
    """Shows nothing. Once `stop` is set, the next update ends the task."""

    def __init__(self, stop: threading.Event) -> None:
        super().__init__(quiet=True)
        self.stop = stop

    def update(self, stage: str, done: int, total: int, *words: str) -> None:
        if self.stop.is_set():
            raise KeyboardInterrupt


def run_in_processes(task: Callable[[str], Any], items: Sequence[str], what: str, progress: Progress) -> None:
    """task(item) of each item, as many at a time as there are cores, each in a process of its own: for libraries that
    threads may not share. The first error is raised and ends the others; so does the end of this process, in any way.
    task: a function that its module has."""
    command = [sys.executable, "-c", _CHILD, task.__module__, task.__name__]
    running: list[subprocess.Popen[str]] = []

    def run(item: str) -> None:
        whole, quiet, heard = [*command, item, str(os.getpid()), *sys.path], subprocess.DEVNULL, subprocess.PIPE
        child = subprocess.Popen(whole, stdout=quiet, stderr=heard, text=True, start_new_session=True)
        running.append(child)
        said = child.communicate()[1].strip()
        if child.returncode and "Traceback" in said:
            raise RuntimeError(said)
        if child.returncode:  # 1: of an InputError, whose line is the last
            told = said.rpartition("\n")[2] if child.returncode == 1 else ""
            why = re.search(r"what\(\): *(.*)", said)  # of a library in C++
            advice = f" ({why[1]})" if why else "; is memory short?"
            raise InputError(told or f"{what}: a process ended with code {child.returncode}{advice}")

    with ThreadPoolExecutor(cores()) as pool:
        submitted = [pool.submit(run, item) for item in items]
        try:
            for done, one in enumerate(as_completed(submitted), start=1):
                one.result()
                progress.update(what, done, len(items))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in running:
                child.kill()


def _on_cores(task: Callable[..., Any], items: Sequence[str], what: str, progress: Progress) -> list[Any]:
    """As many tasks at a time as there are cores, each in a thread of its own."""
    stop = threading.Event()
    with ThreadPoolExecutor(cores()) as pool:
        submitted = [pool.submit(task, item, _Stoppable(stop)) for item in items]
        try:
            progress.update(f"{what}s", 0, len(items))
            for done, one in enumerate(as_completed(submitted), start=1):
                one.result()
                progress.update(f"{what}s", done, len(items))
            return [one.result() for one in submitted]
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
