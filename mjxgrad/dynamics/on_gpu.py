"""What a GPU does in kernels of its own: the whole solve of a state in one program, which stops when that state is done.

Written as operations on arrays with a batch, Newton's method goes on until the last state is done, 5.7 iterations on an ant where
the mean is 1.5, and starts some thirty kernels in each. Here every state has a program that holds J and H in registers. The
kernels are Triton's, by `jax.experimental.pallas`: they are written with whole matrices and no entries, and so are short.

Arrays have the batch as trailing axis, as in `newton`, whose steps and words these are.
"""

import functools
import importlib

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjxgrad.dynamics import constraint
from mjxgrad.dynamics.constraint import RowLayout

# Entries of J in the registers of one thread, and threads of a warp.
_EACH, _WARP = 32, 32
# Of J, zeros that make it a power of two included. More do not fit into registers.
_MOST_ENTRIES = 8192
_MOST_COLUMNS = 32


@functools.cache
def has_kernels() -> bool:
    """Return whether there is a GPU, and a JAX that compiles Triton's kernels for it; those after 0.11 may not."""
    if jax.default_backend() != "gpu":
        return False
    try:
        importlib.import_module("jax.experimental.pallas.triton")
    except ImportError:
        return False
    return True


def padded(size: int) -> int:
    """Return the size of the kernel's matrices, a power of two."""
    return max(16, 1 << (size - 1).bit_length())


def fits(num_rows: int, num_dofs: int) -> bool:
    """Return whether J of this size is for the kernels."""
    width = padded(num_dofs)
    return width <= _MOST_COLUMNS and padded(num_rows) * width <= _MOST_ENTRIES


def minimise(
    layout: RowLayout,
    max_iterations: int,
    mass: Float[Array, "nv nv batch"],
    force: Float[Array, "nv batch"],
    jacobian: Float[Array, "rows nv batch"],
    rows: constraint.Rows,
    start: Float[Array, "nv batch"],
    tolerance: Float[Array, " batch"],
    *,
    interpret: bool = False,
) -> tuple[Float[Array, "nv batch"], Int[Array, " batch"]]:
    """Return what `newton.minimise` does, where the cost along a line is piecewise quadratic."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    from mjxgrad.dynamics import newton

    num_rows, size, batch = jacobian.shape
    height, width, dtype = padded(num_rows), padded(size), start.dtype
    eps = newton._ROUNDING * float(jnp.finfo(dtype).eps)

    def kernel(mass, force, jacobian, weight, reference, low, high, start, tolerance, acceleration, iterations):
        i, k = jnp.arange(width, dtype=jnp.int32), jnp.arange(height, dtype=jnp.int32)
        column, row = jnp.minimum(i, size - 1), jnp.minimum(k, num_rows - 1)

        def of_rows(ref):
            return jnp.where(k < num_rows, ref[row], 0.0)

        def of_dofs(ref):
            return jnp.where(i < size, ref[column], 0.0)

        j = jnp.where((k < num_rows)[:, None] & (i < size)[None], jacobian[row[:, None], column[None]], 0.0)
        unit = jnp.where(i[:, None] == i[None], 1.0, 0.0).astype(dtype)
        m = jnp.where((i < size)[:, None] & (i < size)[None], mass[column[:, None], column[None]], unit)
        w, ref, least, most = of_rows(weight), of_rows(reference), of_rows(low), of_rows(high)
        smooth, diagonal = of_dofs(force), jnp.maximum((m * unit).sum(axis=0), newton.mujoco.mjMINVAL)
        smallest = tolerance[...] ** 2 * jnp.where(i < size, diagonal, 0.0).sum()

        def push(x):
            linear = -w * x
            return jnp.where(linear < least, least, jnp.where(linear > most, most, linear))

        def curve(x):
            linear = -w * x
            return jnp.where((linear > least) & (linear < most), w, 0.0)

        def evaluate(a):
            x = (j * a[None]).sum(axis=1) - ref
            f = push(x)
            return x, f, (m * a[None]).sum(axis=1), (j * f[:, None]).sum(axis=0)

        def floor_of(a, x, f, inertia):
            extent = jnp.abs(x) + jnp.abs(ref)
            return eps**2 * ((a * inertia).sum() + jnp.where(f != 0, w * extent * extent, 0.0).sum())

        def judge(point, near, count):
            """Return the gradient, whether it is finite, whether it is small, and whether to go on."""
            _, _, inertia, pull = point
            gradient = inertia - smooth - pull
            is_sound = _count(~(jnp.abs(gradient) < jnp.inf)) == 0
            noise = eps * (jnp.abs(inertia) + jnp.abs(pull))
            energy, floor = (gradient * gradient / diagonal).sum(), (noise * noise / diagonal).sum()
            is_solved = (near > 0) | (energy < smallest) | (energy <= floor)
            return gradient, is_sound, is_solved, is_sound & ~is_solved & (count < max_iterations)

        def iterate(carry):
            a, point, near, count, _ = carry
            x, f, inertia, _ = point
            gradient = judge(point, near, count)[0]
            bent = j * curve(x)[:, None]
            hessian = m + jnp.dot(bent.T, j, precision="highest")
            newton_step = -_eliminate(hessian, gradient, size)
            is_finite = _count(~(jnp.abs(newton_step) < jnp.inf)) == 0
            direction = jnp.where(is_finite, newton_step, -gradient / diagonal)
            decrement, floor = -(gradient * direction).sum(), floor_of(a, x, f, inertia)
            noise = jnp.sqrt(jnp.maximum(decrement, 0.0) * floor)
            length = search(x, direction, (direction * (inertia - smooth)).sum(), -decrement, noise)
            a = a + length * direction
            point = evaluate(a)
            is_near = (decrement < smallest) | (decrement <= newton._LAST * floor)
            near, count = near | is_near.astype(jnp.int32), count + 1
            return a, point, near, count, judge(point, near, count)[3]

        def search(x, direction, smooth_slope, start, noise):
            along = (j * direction[None]).sum(axis=1)
            smooth_curvature = (direction * (m * direction[None]).sum(axis=1)).sum()
            flat = jnp.maximum(1e-6 * jnp.abs(start), noise)

            def improve(state):
                low, high, length, count, _ = state
                at = x + length * along
                value = smooth_slope + length * smooth_curvature - (push(at) * along).sum()
                curvature = smooth_curvature + (curve(at) * along * along).sum()
                low, high = jnp.where(value < 0, length, low), jnp.where(value < 0, high, length)
                step = length - value / jnp.where(curvature > 0, curvature, 1.0)
                step = jnp.where((step >= low) & (step <= high), step, 0.5 * (low + high))
                return low, high, step, count + 1, (jnp.abs(value) <= flat).astype(jnp.int32)

            high = jnp.maximum(-start / jnp.where(smooth_curvature > 0, smooth_curvature, 1.0), 1.0)
            state = (jnp.zeros_like(start), high, jnp.ones_like(start), jnp.int32(0), jnp.int32(0))
            low, _, length, _, is_flat = jax.lax.while_loop(
                lambda state: (state[3] < newton._LINE_STEPS) & (state[4] == 0), improve, state
            )
            return jnp.where((is_flat > 0) | (low == 0), length, low)

        a = of_dofs(start)
        point, near, count = evaluate(a), jnp.int32(0), jnp.int32(0)
        carry = (a, point, near, count, judge(point, near, count)[3])
        a, point, near, count, _ = jax.lax.while_loop(lambda carry: carry[4], iterate, carry)
        _, is_sound, is_solved, _ = judge(point, near, count)
        x, f, inertia, _ = point
        known = newton._RESOLVED**2 * ((a * inertia).sum() + (smooth * smooth / diagonal).sum())
        is_finished = is_solved & (floor_of(a, x, f, inertia) <= known)
        acceleration[i] = jnp.where(is_sound, a, jnp.nan)
        iterations[...] = jnp.where(is_finished, count, max_iterations + 1).astype(jnp.int32)

    low, high = constraint.bounds(layout, rows)
    inputs = (mass, force, jacobian, rows.weight, rows.reference, low, high, start, tolerance)
    inputs = [jnp.moveaxis(x, -1, 0) for x in inputs]

    def one(x):
        return pallas.BlockSpec((None, *x.shape[1:]), lambda state: (state, *(0,) * (x.ndim - 1)))

    shapes = jax.ShapeDtypeStruct((batch, width), dtype), jax.ShapeDtypeStruct((batch,), jnp.int32)
    found, count = pallas.pallas_call(
        kernel,
        out_shape=shapes,
        in_specs=[one(x) for x in inputs],
        out_specs=tuple(one(x) for x in shapes),
        grid=(batch,),
        compiler_params=triton.CompilerParams(num_warps=max(1, height * width // (_EACH * _WARP)), num_stages=1),
        interpret=interpret,
    )(*inputs)
    return jnp.moveaxis(found[:, :size], 0, -1), count


def _count(truths: Array) -> Array:
    return truths.astype(jnp.int32).sum()


def _eliminate(matrix: Float[Array, "n n"], vector: Float[Array, " n"], size: int) -> Float[Array, " n"]:
    """Return matrix⁻¹ vector, non-finite where the matrix is not positive definite: Gauss and Jordan's, in a kernel."""
    index = jnp.arange(len(vector), dtype=jnp.int32)
    down, across = index[:, None], index[None]

    def eliminate(pivot, carry):
        entries, rest = carry
        row = jnp.where(down == pivot, entries, 0.0).sum(axis=0)
        column = jnp.where(across == pivot, entries, 0.0).sum(axis=1)
        own = jnp.where(index == pivot, rest, 0.0).sum()
        # By the root, so that a pivot that is not positive spoils all.
        inverse = jax.lax.rsqrt(jnp.where(index == pivot, column, 0.0).sum()) ** 2
        factor = jnp.where(index == pivot, 0.0, column * inverse)
        return entries - factor[:, None] * row[None], rest - factor * own

    entries, rest = jax.lax.fori_loop(0, size, eliminate, (matrix, vector))
    pivots = jnp.where(down == across, entries, 0.0).sum(axis=1)
    return rest * jax.lax.rsqrt(pivots) ** 2
