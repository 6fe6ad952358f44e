"""What a GPU does in kernels of its own: the whole solve of a state by one program, which stops when that state is done.

Written as operations on arrays with a batch, Newton's method goes on until the last state is done, 5.7 iterations on an ant where
the mean is 1.5, and starts some thirty kernels in each. Here every state has a program that holds J and H in registers. The
kernels are Triton's, by `jax.experimental.pallas`: they are written with whole matrices and no entries, and so are short.

The columns of J are kept in blocks of sixteen, and so are vectors: to take a row out of a matrix a program adds up all of it.

Arrays have the batch as trailing axis, as in `newton`, whose steps and words these are.
"""

import functools
import importlib

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjxgrad.dynamics import constraint
from mjxgrad.dynamics.constraint import RowLayout

# Joint velocities of a block.
_WIDTH = 16
# Entries of J in the registers of one thread, and threads of a warp.
_EACH, _WARP = 64, 32
# Of J, zeros that make it a power of two included. More do not fit into registers.
_MOST_ENTRIES = 4096
_MOST_BLOCKS = 2

_Block = Float[Array, "16 16"]
_Blocks = list[list[_Block]]
_Parts = list[Float[Array, " 16"]]


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


def _height(num_rows: int) -> int:
    return max(_WIDTH, 1 << (num_rows - 1).bit_length())


def fits(num_rows: int, num_dofs: int) -> bool:
    """Return whether J of this size is for the kernels."""
    num_blocks = -(-num_dofs // _WIDTH)
    return num_blocks <= _MOST_BLOCKS and _height(num_rows) * num_blocks * _WIDTH <= _MOST_ENTRIES


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
    height, num_blocks, dtype = _height(num_rows), -(-size // _WIDTH), start.dtype
    eps = newton._ROUNDING * float(jnp.finfo(dtype).eps)
    product = functools.partial(_product, interpret=interpret or dtype != jnp.float32)
    blocks = range(num_blocks)

    def kernel(mass, force, jacobian, weight, reference, low, high, start, tolerance, acceleration, iterations):
        i, k = jnp.arange(_WIDTH, dtype=jnp.int32), jnp.arange(height, dtype=jnp.int32)
        column, row = [jnp.minimum(_WIDTH * b + i, size - 1) for b in blocks], jnp.minimum(k, num_rows - 1)
        is_row, is_column = k < num_rows, [_WIDTH * b + i < size for b in blocks]

        def of_rows(ref):
            return jnp.where(is_row, ref[row], 0.0)

        def of_dofs(ref):
            return [jnp.where(is_column[b], ref[column[b]], 0.0) for b in blocks]

        unit = jnp.where(i[:, None] == i[None], 1.0, 0.0).astype(dtype)
        j = [jnp.where(is_row[:, None] & is_column[b][None], jacobian[row[:, None], column[b][None]], 0.0) for b in blocks]
        m = [
            [
                jnp.where(
                    is_column[b][:, None] & is_column[c][None],
                    mass[column[b][:, None], column[c][None]],
                    unit if b == c else 0.0,
                )
                for c in blocks
            ]
            for b in blocks
        ]
        w, ref, least, most = of_rows(weight), of_rows(reference), of_rows(low), of_rows(high)
        smooth = of_dofs(force)
        diagonal = [jnp.maximum((m[b][b] * unit).sum(axis=0), newton.mujoco.mjMINVAL) for b in blocks]
        smallest = tolerance[...] ** 2 * sum(jnp.where(is_column[b], diagonal[b], 0.0).sum() for b in blocks)

        def push(x):
            linear = -w * x
            return jnp.where(linear < least, least, jnp.where(linear > most, most, linear))

        def curve(x):
            linear = -w * x
            return jnp.where((linear > least) & (linear < most), w, 0.0)

        def rates(a):
            return sum((j[b] * a[b][None]).sum(axis=1) for b in blocks)

        def accelerate(a):
            return [sum((m[b][c] * a[c][None]).sum(axis=1) for c in blocks) for b in blocks]

        def evaluate(a):
            x = rates(a) - ref
            f = push(x)
            return x, f, accelerate(a), [(j[b] * f[:, None]).sum(axis=0) for b in blocks]

        def floor_of(a, x, f, inertia):
            extent = jnp.abs(x) + jnp.abs(ref)
            return eps**2 * (_dot(a, inertia) + jnp.where(f != 0, w * extent * extent, 0.0).sum())

        def judge(point, near, count):
            """Return the gradient, whether it is finite, whether it is small, and whether to go on."""
            _, _, inertia, pull = point
            gradient = [inertia[b] - smooth[b] - pull[b] for b in blocks]
            noise = [eps * (jnp.abs(inertia[b]) + jnp.abs(pull[b])) for b in blocks]
            energy, floor = (sum((v[b] * v[b] / diagonal[b]).sum() for b in blocks) for v in (gradient, noise))
            is_sound, is_solved = _is_finite(gradient), (near > 0) | (energy < smallest) | (energy <= floor)
            return gradient, is_sound, is_solved, is_sound & ~is_solved & (count < max_iterations)

        def iterate(carry):
            a, point, near, count, _ = carry
            x, f, inertia, _ = point
            gradient = judge(point, near, count)[0]
            bent = [(j[b] * curve(x)[:, None]).T for b in blocks]
            hessian = [[m[b][c] + product(bent[b], j[c]) if b <= c else None for c in blocks] for b in blocks]
            solution = _solve(hessian, gradient, size, product)
            is_finite = _is_finite(solution)
            direction = [jnp.where(is_finite, -solution[b], -gradient[b] / diagonal[b]) for b in blocks]
            decrement, floor = -_dot(gradient, direction), floor_of(a, x, f, inertia)
            noise = jnp.sqrt(jnp.maximum(decrement, 0.0) * floor)
            slope = _dot(direction, [inertia[b] - smooth[b] for b in blocks])
            length = search(x, direction, slope, -decrement, noise)
            a = [a[b] + length * direction[b] for b in blocks]
            point = evaluate(a)
            is_near = (decrement < smallest) | (decrement <= newton._LAST * floor)
            near, count = near | is_near.astype(jnp.int32), count + 1
            return a, point, near, count, judge(point, near, count)[3]

        def search(x, direction, smooth_slope, start, noise):
            along, smooth_curvature = rates(direction), _dot(direction, accelerate(direction))
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
        known = newton._RESOLVED**2 * (_dot(a, inertia) + sum((smooth[b] * smooth[b] / diagonal[b]).sum() for b in blocks))
        is_finished = is_solved & (floor_of(a, x, f, inertia) <= known)
        for b in blocks:
            acceleration[_WIDTH * b + i] = jnp.where(is_sound, a[b], jnp.nan)
        iterations[...] = jnp.where(is_finished, count, max_iterations + 1).astype(jnp.int32)

    low, high = constraint.bounds(layout, rows)
    inputs = (mass, force, jacobian, rows.weight, rows.reference, low, high, start, tolerance)
    inputs = [jnp.moveaxis(x, -1, 0) for x in inputs]

    def one(x):
        return pallas.BlockSpec((None, *x.shape[1:]), lambda state: (state, *(0,) * (x.ndim - 1)))

    width = _WIDTH * num_blocks
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


def _product(one: Array, other: Array, interpret: bool) -> Array:
    """Return one other, of single precision by three products of tensor cores, whose error is 10⁻⁶ of the largest term."""
    if interpret:
        return jnp.dot(one, other, precision="highest")
    return jnp.dot(one, other, precision=jax.lax.DotAlgorithmPreset.TF32_TF32_F32_X3)


def _dot(one: _Parts, other: _Parts) -> Array:
    return sum((x * y).sum() for x, y in zip(one, other, strict=True))


def _is_finite(parts: _Parts) -> Array:
    return sum((~(jnp.abs(part) < jnp.inf)).astype(jnp.int32).sum() for part in parts) == 0


def _solve(matrix: _Blocks, vector: _Parts, size: int, product) -> _Parts:
    """Return matrix⁻¹ vector, non-finite where the matrix is not positive definite; of the matrix what is not below the diagonal."""
    if size <= _WIDTH:
        return [_eliminate(matrix[0][0], vector[0], size)]
    others = range(1, len(vector))
    inverse = _inverse(matrix[0][0])
    above = [product(inverse, matrix[0][c]) for c in others]
    rest = [[matrix[b][c] - product(matrix[0][b].T, above[c - 1]) if b <= c else None for c in others] for b in others]
    first = (inverse * vector[0][None]).sum(axis=1)
    left = [vector[b] - (matrix[0][b] * first[:, None]).sum(axis=0) for b in others]
    found = _solve(rest, left, size - _WIDTH, product)
    return [first - sum((above[b - 1] * found[b - 1][None]).sum(axis=1) for b in others), *found]


def _eliminate(matrix: _Block, vector: Float[Array, " 16"], size: int) -> Float[Array, " 16"]:
    """Return matrix⁻¹ vector: Gauss and Jordan's."""
    index = jnp.arange(_WIDTH, dtype=jnp.int32)
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


def _inverse(matrix: _Block) -> _Block:
    """Return the inverse, by Gauss and Jordan's."""
    index = jnp.arange(_WIDTH, dtype=jnp.int32)
    down, across = index[:, None], index[None]

    def eliminate(pivot, entries):
        row = jnp.where(down == pivot, entries, 0.0).sum(axis=0)
        column = jnp.where(across == pivot, entries, 0.0).sum(axis=1)
        inverse = jax.lax.rsqrt(jnp.where(index == pivot, column, 0.0).sum()) ** 2
        # The pivot's row and column become those of the inverse: by what the update leaves of 1 and -1 in the pivot's place.
        row = jnp.where(index == pivot, 1.0, row)
        column = jnp.where(index == pivot, -1.0, column)
        rest = jnp.where((down == pivot) | (across == pivot), 0.0, entries)
        return rest - (column * inverse)[:, None] * row[None]

    return jax.lax.fori_loop(0, _WIDTH, eliminate, matrix)
