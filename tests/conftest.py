"""Double precision for all tests: tolerances are then about formulas, not about rounding."""

import functools
import gc
import os
import signal
from pathlib import Path

import jax
import pytest
from jax._src.interpreters import mlir

jax.config.update("jax_enable_x64", True)
# Where in Python each operation came from is a fifth of what lowering a small program takes, and no test reads it.
jax.config.update("jax_traceback_in_locations_limit", 0)

# JAX makes an MLIR context for each program, half of what lowering a small one takes, and keeps it as long as its function.
# The more there are, the longer each use of a new one takes (jax 0.10.2: 6 ms alone, 17 ms beside 2000 others): after as many
# it was 46 % of a worker's time. All programs of a file share one.
if is_shared := hasattr(mlir, "make_ir_context"):
    mlir.make_ir_context = functools.cache(mlir.make_ir_context)

# Compilation is most of the time of the tests. XLA's quick code takes a third of it (two bodies' gradient, jax 0.10.2: 10 s of
# processor time in place of 28) and runs at half the speed; the operations are the same. The slow tests compile as users do.
_QUICK_CODE = (
    "--xla_backend_optimization_level=0 --xla_disable_hlo_passes="
    "simplify-while-loops,while-loop-invariant-code-motion,while-loop-constant-sinking,hlo-verifier"
)
if jax.__version_info__ < (0, 11):  # XLA ends the process at a flag that it no longer knows
    # XLA's own choices for quick compilation, and a program as one module: else it is cut in up to 32 for as many threads, which
    # two workers on two processors do not have (estimates of pytrees and slots of contacts: 18.6 s in place of 22.7).
    _QUICK_CODE += (
        " --xla_cpu_use_fusion_emitters=false --xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_COMPILE"
        " --xla_cpu_parallel_codegen_split_count=1"
    )


MAPS = Path("/proc/self/maps")

# Traces are large, long-lived graphs of Python objects: to search all of them for garbage each time is a tenth of the time.
gc.set_threshold(200_000, 50, 1000)


def pytest_configure(config: pytest.Config) -> None:
    # Threads of linear algebra wait for one another by spinning, which two workers on two processors pay for. The matrices
    # here are small. Workers take this from the process that starts them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if config.getoption("markexpr") == "not slow":
        os.environ["XLA_FLAGS"] = f"{_QUICK_CODE} {os.environ.get('XLA_FLAGS', '')}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    try:
        return (yield)
    except ValueError as error:  # beside a MuJoCo later than MJX, make mujoco4
        if "mjxgrad[mjx]" in str(error):
            pytest.skip("MJX has the maths of another MuJoCo")
        raise


def pytest_runtest_teardown(item, nextitem):
    """Give compiled programs back before a process has as many pieces of memory as Linux allows, 65530; XLA then crashes."""
    if nextitem is not None and nextitem.path == item.path:
        return
    if is_shared:
        mlir.make_ir_context.cache_clear()
    if MAPS.exists() and len(MAPS.read_bytes().splitlines()) > 30_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(autouse=True)
def hears_interrupts():
    """A shell's background processes ignore Ctrl-C, and tests would wait there for what it ends."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def key():
    return jax.random.key(7)


@pytest.fixture
def compilations():
    """What has been compiled since the test began, one entry for each program."""
    found = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: found.append(event) if event.endswith("backend_compile_duration") else None
    )
    return found
