"""What the benchmarks promise before they measure."""

from tests.processes import run_python


def test_nothing_begins_jax_before_the_number_of_devices_is_read():
    """`--per-core` makes devices, which JAX refuses once it has begun: an array at the top of a module is enough."""
    script = (
        "import jax, experiments.benchmarks\n"
        "jax.config.update('jax_num_cpu_devices', 2)\n"
        "assert len(jax.devices('cpu')) == 2"
    )
    run_python("-c", script)
