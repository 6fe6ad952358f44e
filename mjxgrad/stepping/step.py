"""The differentiable step."""

import mujoco

from mjxgrad._mjx import mjx
from mjxgrad.stepping import pairs
from mjxgrad.stepping.contact import Contact, Discrete, Slope, check_contact
from mjxgrad.stepping.forward import advance, at_full_precision

_Integrator = mujoco.mjtIntegrator


def step(model: mjx.Model, data: mjx.Data, *, contact: Contact = Discrete()) -> mjx.Data:
    """Advance the state by one time step.

    Args:
        model: any model of MJX's JAX implementation; Euler, implicitfast or RK4.
        data: the present state, controls and applied forces.
        contact: how contact is stepped; see `stepping.contact`. The default is `mjx.step`'s motion, with its derivative. With
            `mg.Slope()` each step tells of its own events; `mg.rollout` follows them from step to step.

    Returns:
        Data whose state is one time step later and whose other fields are those of the present state, as `mjx.step` returns
        them. Differentiable with respect to every floating-point field of `model` and `data`, any number of times.
        `_impl.solver_niter` is the solve's number of iterations, the largest of Runge-Kutta's four. It is `opt.iterations` + 1
        where the iterations, or the digits of the precision, did not suffice.

    Raises:
        ValueError: if `model` or `data` belong to another implementation of MJX, or contact is none of the four records or has
            a leading axis.
        NotImplementedError: if MJX lacks the integrator.
    """
    check_contact(contact)
    with at_full_precision(model, data):
        if model.opt.integrator not in (_Integrator.mjINT_EULER, _Integrator.mjINT_IMPLICITFAST, _Integrator.mjINT_RK4):
            kind = model.opt.integrator
            raise NotImplementedError(f"integrator must be Euler, implicitfast or RK4, got {kind}: set it in <option>")
        if not isinstance(contact, Slope):
            return advance(model, data, contact)
        moved, flight = pairs.follow(pairs.Program(model, data), pairs.no_flight(model, data))
        return pairs.put(moved, pairs.whole(model, pairs.taken(moved), flight))
