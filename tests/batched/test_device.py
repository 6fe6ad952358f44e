"""A batch over several devices; in a process of its own, since their number is fixed at the first use of JAX."""

import textwrap

import jax.numpy as jnp
import numpy as np

import mjxgrad as mg
from tests.processes import run_python

_PROGRAM = """
    import jax
    import jax.numpy as jnp
    import numpy as np

    import experiments.benchmarks  # whose --per-core makes devices, too
    import mjxgrad as mg

    jax.config.update("jax_num_cpu_devices", 8)  # which fails if an import has used a device


    def root(x, start):  # a loop that each member leaves at its own time
        return jax.lax.while_loop(lambda y: jnp.abs(y * y - x["square"]) > 1e-4, lambda y: (y + x["square"] / y) / 2, start)


    squares, starts = {"square": jnp.linspace(1.0, 400.0, 16)}, jnp.ones(16)
    function = jax.jit(mg.over_devices(root))
    found = function(squares, starts)
    assert len(found.sharding.device_set) == 8
    np.testing.assert_array_equal(found, jax.vmap(root)(squares, starts))
    text = function.lower(squares, starts).compile().as_text()
    assert not any(word in text for word in ("all-reduce", "all-gather", "collective")), "devices wait for each other"
    # Inputs without a number, used, of all and of each; jax 0.11.2 crashes on them as they are.
    empty = mg.over_devices(lambda x, y, z: (x.sum() + y + z.sum(), 3 * z), num_shared=1)
    found = jax.jit(empty)(jnp.ones((0, 2)), starts, jnp.ones((16, 0)))
    np.testing.assert_array_equal(found[0], starts)
    assert found[1].shape == (16, 0)
    for count, said in ((4, "the batch must be a multiple of the 8 devices, got 4"), (16, "have the batch as leading axis")):
        try:
            function({"square": jnp.ones(count)}, jnp.ones(4))
        except ValueError as error:
            assert said in str(error)
        else:
            raise AssertionError("an uneven batch was taken")
"""


def test_each_device_works_on_its_part_alone():
    run_python("-c", textwrap.dedent(_PROGRAM))


def test_one_device_is_vmap():
    function = mg.over_devices(lambda x, y: x @ y)
    x = jnp.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(function(x, x), [1.0, 13.0, 41.0])
