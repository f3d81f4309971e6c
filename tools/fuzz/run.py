"""Fuzzes one reader, a server or the compiled module.

python tools fuzz.run TARGET [--runs N]        # --list names the targets

Coverage-guided by atheris where it is installed (pip install atheris), else seeded mutation of the same seeds. A defect
is everything but a clean refusal: another exception, a signal, a hang, or memory beyond --memory. Its input is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

LONGEST = 4096
HANG = 20
"""Seconds of processor time after which one input counts as a hang."""


def _targets() -> dict[str, Callable[[], Any]]:
    from fuzz.core import CoreTarget
    from fuzz.map_json import MapJson
    from fuzz.served import HttpTarget, PromptTarget, ViewerTarget, served_map
    from fuzz.targets import TARGETS

    served = {
        "http": HttpTarget,
        "served-map": served_map,
        "viewer": ViewerTarget,
        "prompt": PromptTarget,
        "map-json": MapJson,
    }
    return {"core": CoreTarget, **TARGETS, **served}


def load(name: str) -> Any:
    """The target of that name: `seeds()`, `run(data)`, `words`."""
    return _targets()[name]()


def names() -> list[str]:
    """Every target there is."""
    return list(_targets())


def mutate(data: bytes, rng: random.Random, words: list[str], others: list[bytes]) -> bytes:
    """A few random edits: bytes flipped, cut, doubled, filled, words put in, another input's tail spliced on."""
    out = bytearray(data)
    for _ in range(1 + rng.getrandbits(2)):
        at, kind = rng.randrange(len(out) + 1), rng.randrange(8)
        end = min(len(out), at + 1 + rng.getrandbits(rng.randrange(8)))
        if kind == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(out):
            out[at] = rng.choice((0, 1, 0x20, 0x30, 0x39, 0x7F, 0x80, 0xFF, rng.getrandbits(8)))
        elif kind == 2:
            del out[at:end]
        elif kind == 3:
            out[at:at] = out[at:end]
        elif kind == 4:
            out[at:at] = rng.choice(words).encode("latin-1") if words else bytes([rng.getrandbits(8)])
        elif kind == 5:
            out[at:end] = bytes([rng.choice((0, 0xFF, 0x30, 0x2D))]) * (end - at)
        elif kind == 6:
            out[at:end] = rng.choice(words).encode("latin-1") if words else b""
        else:
            other = rng.choice(others)
            out[at:] = other[rng.randrange(len(other) + 1) :]
    return bytes(out[:LONGEST])


class Session:
    """Runs inputs, counts them, keeps what is wrong."""

    def __init__(self, target: Any, folder: Path, keep_going: bool):
        self.target, self.folder, self.keep_going = target, folder, keep_going
        self.runs = self.read = 0
        self.started = time.perf_counter()
        self.longest = 0.0
        self.defects: set[str] = set()

    def one(self, data: bytes) -> None:
        """Runs one input; a new defect is told and its input written, and raised unless we keep going."""
        self.runs += 1
        began = time.perf_counter()
        try:
            self.read += bool(self.target.run(data))
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            own = [f for f in frames if "/perception/" in f.filename or "/fuzz/" in f.filename] or list(frames)
            key = f"{type(error).__name__} at {own[-1].filename.rsplit('/', 2)[-1]}:{own[-1].lineno}"
            if key not in self.defects:
                self.defects.add(key)
                file = self.folder / f"defect-{hashlib.sha256(data).hexdigest()[:12]}"
                file.write_bytes(data)
                shown = " ".join(str(error).split())[:200]
                print(f"DEFECT {key}: {shown}\n  input kept in {file}", file=sys.stderr, flush=True)
            if not self.keep_going:
                raise
        finally:
            self.longest = max(self.longest, time.perf_counter() - began)

    def summary(self) -> str:
        seconds = time.perf_counter() - self.started
        return (
            f"{self.runs} inputs in {seconds:.0f} s ({self.runs / seconds:.0f}/s), {self.read} read, "
            f"{self.runs - self.read} refused, {len(self.defects)} defects, "
            f"the longest took {1e3 * self.longest:.0f} ms"
        )


def limit_memory(mebibytes: int) -> None:
    """The address space may grow by so much from here on (AddressSanitizer reserves it whole: see ASAN_OPTIONS)."""
    if "libasan" in Path("/proc/self/maps").read_text():
        return
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (mebibytes << 20), resource.getrlimit(resource.RLIMIT_AS)[1]))


def _hang(number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"one input took more than {HANG} s")


def by_mutation(session: Session, runs: int, seconds: float, seed: int) -> None:
    """Seeded mutation without coverage; the same inputs for the same seed."""
    rng, seeds = random.Random(seed), session.target.seeds()
    signal.signal(signal.SIGPROF, _hang)
    last = session.folder / "last-input"  # what it was doing when it died of a signal
    pool = list(seeds)
    while session.runs < runs and time.perf_counter() - session.started < seconds:
        fresh = session.target.decides and rng.random() < 0.5
        data = rng.randbytes(64) if fresh else mutate(rng.choice(pool), rng, session.target.words, seeds)
        last.write_bytes(data)
        before = session.read
        signal.setitimer(signal.ITIMER_PROF, HANG)
        session.one(data)
        signal.setitimer(signal.ITIMER_PROF, 0)
        if session.read > before:  # a good input is a good start
            pool = [*seeds, *pool[len(seeds) :][-200:], data]
    last.unlink(missing_ok=True)


def by_coverage(session: Session, runs: int, seconds: float, seed: int, corpus: Path) -> None:
    """libFuzzer through atheris. Never returns: libFuzzer ends the process, 0 without a defect."""
    import atheris

    for data in session.target.seeds():
        (corpus / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
    options = [
        f"-runs={runs}",
        f"-seed={seed + 1}",
        f"-max_len={LONGEST}",
        f"-timeout={10 * HANG}",
        "-rss_limit_mb=4096",
    ]
    options += [
        f"-artifact_prefix={session.folder}/",
        "-print_final_stats=1",
        "-close_fd_mask=0",
    ]
    if session.target.words:
        dictionary = session.folder / "words.dict"
        escaped = ["".join(f"\\x{byte:02x}" for byte in word.encode("latin-1")) for word in session.target.words]
        dictionary.write_text("".join(f'"{word}"\n' for word in escaped))
        options.append(f"-dict={dictionary}")
    if seconds < float("inf"):
        options.append(f"-max_total_time={int(seconds)}")
    atheris.Setup([sys.argv[0], *options, str(corpus)], session.one)
    _count_compiled_edges()
    atheris.Fuzz()


def _count_compiled_edges() -> None:
    """Gives libFuzzer the counters of a core built with PERCEPTION_COVERAGE; nothing to do for another."""
    import ctypes

    from atheris import core_with_libfuzzer  # type: ignore[attr-defined]

    from perception import _core

    core = ctypes.CDLL(_core.__file__)
    if hasattr(core, "perception_coverage"):
        begin, end = ctypes.c_void_p(), ctypes.c_void_p()
        core.perception_coverage(ctypes.byref(begin), ctypes.byref(end))
        ctypes.CDLL(core_with_libfuzzer.__file__).__sanitizer_cov_8bit_counters_init(begin, end)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", nargs="?", help="what to fuzz")
    parser.add_argument("--list", action="store_true", help="name the targets")
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", choices=("auto", "atheris", "mutate"), default="auto")
    parser.add_argument("--memory", type=int, help="MiB that reading a few kilobytes may take (512; pictures 6144)")
    parser.add_argument("--out", type=Path, help="where inputs of defects and the corpus go (default: a new folder)")
    parser.add_argument("--keep-going", action="store_true", help="go on after a defect")
    parser.add_argument("--replay", type=Path, nargs="+", help="run these inputs only")
    given = parser.parse_args(arguments)
    if given.list or given.target not in names():
        print("\n".join(names()))
        return 0 if given.list else 2
    folder = given.out or Path(tempfile.mkdtemp(prefix=f"fuzz-{given.target}-"))
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    engine = _engine(given.engine)
    target = _instrumented(given.target) if engine == "atheris" else load(given.target)
    for number, data in enumerate(target.seeds()):  # also imports what readers import late
        if not target.run(data):
            raise SystemExit(f"seed {number} of {given.target} is refused: the target reaches nothing")
    limit_memory(given.memory or target.memory)
    session = Session(target, folder, given.keep_going)
    if given.replay:
        for file in given.replay:
            session.one(file.read_bytes())
    elif engine == "atheris":
        by_coverage(session, given.runs, given.seconds, given.seed, corpus)
    else:
        by_mutation(session, given.runs, given.seconds, given.seed)
    print(f"{given.target} ({engine}): {session.summary()}")
    return 1 if session.defects else 0


def _engine(wanted: str) -> str:
    if wanted != "auto":
        return wanted
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("atheris is not installed: seeded mutation without coverage", file=sys.stderr)
        return "mutate"
    return "atheris"


def _instrumented(name: str) -> Any:
    import atheris

    with atheris.instrument_imports(include=["perception", "yaml", "tomllib", "PIL", "zipfile", "fuzz"]):
        target = load(name)
        for data in target.seeds():
            target.run(data)
    return target


if __name__ == "__main__":
    raise SystemExit(main())
