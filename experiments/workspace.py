"""What a running experiment sees of its output folder, its clock and its terminal."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

if TYPE_CHECKING:
    from mjxgrad.scene import Scene


class Workspace:
    """An output folder under construction, with the time of its stages and what a reader must know of its scenes."""

    def __init__(self, folder: Path, kept: Path | None = None):
        self.folder = folder
        self._kept = folder / "kept" if kept is None else kept
        self.seconds: dict[str, float] = {}
        self.warnings: list[str] = []

    def keep(self, name: str) -> Path:
        """Return where to write what outlives an interruption, and is there again when the same run is begun anew."""
        self._kept.mkdir(parents=True, exist_ok=True)
        return self._kept / name

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
