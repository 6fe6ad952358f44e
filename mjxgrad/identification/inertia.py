r"""The inertia of a rigid body as ten unconstrained numbers.

The mass $m$, first moment $h$ and second moments $\Sigma = \int x x^T \mathrm{d}m$ form the pseudo-inertia. It is positive
definite for every physically possible body,

$$J = \begin{pmatrix} \Sigma & h \\ h^T & m \end{pmatrix} = U U^T, \qquad U = e^{\alpha} \begin{pmatrix} e^{d_1} & s_{12} &
s_{13} & t_1 \\ & e^{d_2} & s_{23} & t_2 \\ & & e^{d_3} & t_3 \\ & & & 1 \end{pmatrix}.$$

The ten numbers are $(\alpha, d_1, d_2, d_3, s_{12}, s_{23}, s_{13}, t_1, t_2, t_3)$, as in `mujoco.sysid`. The mass is
$e^{2 \alpha}$, and $t$ the centre of mass.

MuJoCo stores principal moments and their axes. For equal moments the axes have no derivative, though the tensor has one.
The moments are therefore separated by a share of $\sqrt\epsilon$, too little to affect the motion.

References:
    Rucker, Wensing. Smooth parameterization of rigid-body inertia. IEEE Robotics and Automation Letters 7(2), 2022.
"""

import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.spatial
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.identification.parameters import Parameter
from mjxgrad.scene import Scene
from mjxgrad.stepping.rows import index_of

# The bounds of `mujoco.sysid`: the mass by a factor of 10, stretches by 2, shears by 0.5, the centre of mass by 0.5 m.
_REACH = np.array([np.log(10) / 2, *[np.log(2) / 2] * 3, *[0.5] * 3, *[0.5] * 3])


def inertia(scene: Scene, body: str) -> Parameter:
    """Return mass, centre of mass and inertia tensor of a named body as ten unconstrained numbers.

    Raises:
        ValueError: if there is no such body, or a flat body makes a logarithm infinite.
    """

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        index, parts = index_of(model, mujoco.mjtObj.mjOBJ_BODY, body), body_fields(pseudo_inertia(value))
        return {name: getattr(model, name).at[index].set(part) for name, part in parts.items()}

    index = index_of(scene.model, mujoco.mjtObj.mjOBJ_BODY, body)
    names = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    fields = [np.asarray(getattr(scene.model, name), float)[index] for name in names]
    nominal = logarithms(second_moments(*fields))
    if not np.isfinite(nominal).all():
        raise ValueError(f"inertia needs a body with mass and extent in all directions, got {body!r}")
    return Parameter(nominal, nominal - _REACH, nominal + _REACH, write=write)


def pseudo_inertia(numbers: Float[Array, "10"]) -> Float[Array, "4 4"]:
    """Return the pseudo-inertia of ten numbers (kg, kg m, kg m²)."""
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = numbers
    rows = [[jnp.exp(d1), s12, s13, t1], [0, jnp.exp(d2), s23, t2], [0, 0, jnp.exp(d3), t3], [0, 0, 0, 1]]
    root = jnp.exp(alpha) * jnp.array(rows)
    return root @ root.T


def logarithms(pseudo: np.ndarray) -> np.ndarray:
    """Return the ten numbers of a pseudo-inertia; NaN where it is not positive definite."""
    try:
        root = np.linalg.cholesky(pseudo[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError:
        return np.full(10, np.nan)
    unit = root / root[3, 3]
    shears = (unit[0, 1], unit[1, 2], unit[0, 2])
    return np.array([np.log(root[3, 3]), *np.log(np.diag(unit)[:3]), *shears, *unit[:3, 3]])


def second_moments(mass: float | np.ndarray, centre: np.ndarray, moments: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia from MuJoCo's fields of a body: mass, ipos, inertia and iquat."""
    rotation = scipy.spatial.transform.Rotation.from_quat(axes, scalar_first=True).as_matrix()
    about_centre = rotation @ np.diag(moments.sum() / 2 - moments) @ rotation.T
    offset = np.append(centre, 1.0)
    return mass * np.outer(offset, offset) + np.pad(about_centre, (0, 1))


def body_fields(pseudo: Float[Array, "4 4"]) -> dict[str, Float[Array, "..."]]:
    """Return MuJoCo's fields of the body with this pseudo-inertia; differentiable even for equal principal moments."""
    mass, centre = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    spread = pseudo[:3, :3] - mass * jnp.outer(centre, centre)
    separation = jnp.sqrt(jnp.finfo(spread.dtype).eps) * jnp.trace(spread)
    along, axes = jnp.linalg.eigh(spread + separation * jnp.diag(jnp.arange(3.0)))
    axes = axes * jnp.sign(jnp.linalg.det(axes))
    moments, turn = jnp.sum(along) - along, Rotation.from_matrix(axes).as_quat(scalar_first=True)
    return {"body_mass": mass, "body_ipos": centre, "body_inertia": moments, "body_iquat": turn}
