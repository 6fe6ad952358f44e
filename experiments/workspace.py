"""What a running experiment sees of its output folder, its clock, its terminal and its machine."""

import contextlib
import os
import pickle
import re
import sys
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from tqdm import tqdm

from experiments.output import write_whole, writing

if TYPE_CHECKING:
    from mjxgrad.scene import Scene

_Item, _Found = TypeVar("_Item"), TypeVar("_Found")
_MOST = 8  # programs that are compiled side by side, at most: the largest take a gigabyte each


class Workspace:
    """An output folder under construction, with the time of its stages and what a reader must know of its scenes."""

    def __init__(self, folder: Path, kept: Path | None = None):
        self.folder = folder
        self._kept = folder / "kept" if kept is None else kept
        self.seconds: dict[str, float] = {}
        self.kept_seconds = 0.0
        self.warnings: list[str] = []
        self._caught: list[warnings.WarningMessage] = []

    def keep(self, name: str) -> Path:
        """Return where to write what outlives an interruption, and is there again when the same run is begun anew."""
        self._kept.mkdir(parents=True, exist_ok=True)
        return self._kept / name

    def once(self, name: str, compute: Callable[[], _Found]) -> _Found:
        """Compute a part of the work, or take it over from the same run, interrupted after this part.

        Each part has a name of its own. What it warned of is told again, and its time counts.
        """
        safe = re.sub(r"[^\w.,=+-]", "_", name)
        path = self.keep(f"{safe[:80]}-{zlib.crc32(name.encode()):08x}.part")
        # Written whole, by this very source: its name has a hash of all that decides a result.
        if path.is_file():
            found, seconds, told = pickle.loads(path.read_bytes())
            self.kept_seconds += seconds
            self.warnings += told
            return found
        started, before = time.perf_counter(), len(self.told)
        found = compute()
        content = pickle.dumps((found, time.perf_counter() - started, self.told[before:]))
        with writing(self.folder):
            write_whole(path, content)
        return found

    def each(self, stage: str, unit: str, parts: Mapping[str, Callable[[], _Found]]) -> list[_Found]:
        """Compute the parts of a stage by name, one after another and each `once`."""
        found = []
        with self.stage(stage, unit, len(parts)) as advance_to:
            for name, compute in parts.items():
                found.append(self.once(name, compute))
                advance_to(len(found))
        return found

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Take what the library warns of for the report, instead of the terminal."""
        with warnings.catch_warnings(record=True) as self._caught:
            warnings.simplefilter("always")
            yield

    @property
    def told(self) -> list[str]:
        """What the library has warned of."""
        return [str(w.message) for w in self._caught if issubclass(w.category, UserWarning)]

    def check(self, scene: "Scene", *, speed: float | None = None, name: str | None = None) -> None:
        """Note what the time step of a scene, whose bodies meet at a speed (m/s), does not follow, for the report."""
        # A configuration is checked before anything heavy is imported.
        from mjxgrad.diagnostics.stability import check_stability

        self.warnings += [f"{name or scene.name}: {text}" for text in check_stability(scene, speed=speed).warnings]

    @contextlib.contextmanager
    def stage(self, name: str, unit: str, total: int) -> Iterator[Callable[[int], None]]:
        """Time a stage of so many units and show how far it is; the function that it gives is told how many are done."""
        start = time.perf_counter()
        is_terminal = sys.stderr.isatty()
        # A log is no place for a bar that redraws itself ten times a second.
        interval = 0.1 if is_terminal else 15.0
        bar = tqdm(desc=f"  {name}", unit=f" {unit}", total=total, mininterval=interval, dynamic_ncols=True)
        stop = threading.Event()

        def keep_alive() -> None:
            # The first step compiles, for half a minute: the clock must be seen to run.
            while not stop.wait(interval + 0.9):
                bar.refresh()

        ticking = threading.Thread(target=keep_alive, daemon=True)
        ticking.start()

        def advance_to(done: int) -> None:
            bar.update(done - bar.n)

        try:
            yield advance_to
        finally:
            stop.set()
            ticking.join()
            bar.close()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


class CompileClock:
    """The time that JAX spends on compiling in this process, from where it is made.

    Tracing is left out of it, for JAX reports that of nested functions twice.
    """

    def __init__(self):
        import jax

        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.endswith("backend_compile_duration"):
            self.seconds += duration_secs


def num_cores() -> int:
    """Count the cores that this process may use."""
    has_affinity = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1


def num_compilers() -> int:
    """Say how many programs to compile side by side: one per core, as many as memory has room for."""
    return min(num_cores(), _MOST)


def in_threads(
    function: Callable[[_Item], _Found], items: Iterable[_Item], advance_to: Callable[[int], None] = lambda _: None
) -> list[_Found]:
    """Call a function on every item, in threads: XLA compiles each mostly on one core and without Python.

    Results keep the order, and `advance_to` is told how many there are.
    """
    done = []
    with ThreadPoolExecutor(num_compilers()) as pool:
        for result in pool.map(function, items):
            done.append(result)
            advance_to(len(done))
    return done
