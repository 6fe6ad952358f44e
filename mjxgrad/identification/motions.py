"""Simulated motions of a scene with other numbers: by C MuJoCo on all cores, or in one program of MJX."""

import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad._programs import compile_once
from mjxgrad._warnings import collected
from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.engines import QUICK, engine_of
from mjxgrad.engines.layout import MOTION, USER
from mjxgrad.engines.pool import pool_of
from mjxgrad.identification.parameters import Coordinates, Parameter, write_all
from mjxgrad.identification.recording import STATES, Windows
from mjxgrad.rollouts import State, rollout
from mjxgrad.scene import Scene, sensor
from mjxgrad.scene.numbers import with_numbers
from mjxgrad.scene.scene import changed_numbers
from mjxgrad.stepping import Contact, Discrete

AT_ONCE = 32  # values in one call: an interruption waits for it
_START = ("time", *MOTION)
Signals = dict[str, Float[np.ndarray, "values windows times _"]]
"""Positions, velocities, activations and sensors by name, in each state."""


class Motions:
    """Motions of windows with other values and starts.

    MuJoCo's own motion is by C MuJoCo unless the scene's engine was chosen: nothing is compiled but a small program that
    turns values into numbers of the model. It depends on shapes alone, so that a loop over data compiles nothing.
    """

    def __init__(
        self, scene: Scene, parameters: Mapping[str, Parameter], *, delay: str | None, contact: Contact | None
    ):
        self.scene = scene if scene.chosen else scene.with_engine(QUICK)
        self.parameters, self.coordinates = parameters, Coordinates.of(parameters)
        self._delay, self._contact = delay, contact or Discrete()
        self._engine, self._pool = engine_of(self.scene, self._contact), pool_of(scene.mj_model)
        self._arrays, self._rest = eqx.partition(self.scene, eqx.is_array)
        self._programs: dict[Any, Any] = {}

    def put(self, vector: Float[np.ndarray, " dim"]) -> Scene:
        """Return the scene with these values."""
        return self._written(self.scene, jnp.asarray(vector, self.scene.data.qpos.dtype))

    def _written(self, scene: Scene, vector: Array) -> Scene:
        return write_all(scene, self.parameters, self.coordinates.unravel(vector))

    @property
    def compiles(self) -> bool:
        """Whether another number of steps is another program."""
        return self._engine.compiles

    def residuals(
        self,
        windows: Windows,
        values: Float[np.ndarray, "values dim"],
        starts: Float[np.ndarray, "values windows both"],
        steps: int | None = None,
    ) -> Float[np.ndarray, "values windows numbers"]:
        """Return the simulated less the measured signals, in units of the noise; infinite where a motion is not finite.

        Args:
            windows: the measurements.
            values: those of the parameters, one row per simulation.
            starts: changes of the starts: positions and velocities in tangent space.
            steps: those that are simulated; later measurements do not count.
        """
        last = steps or windows.controls.shape[1]
        found, index = [], np.minimum(windows.index, last)  # a measurement at the last state has a share of 0
        counts = windows.index + windows.share <= last
        place = np.arange(len(index))[:, None]
        for begin in range(0, len(values), AT_ONCE):
            part, chunk = slice(begin, begin + AT_ONCE), []
            signals = self.signals(windows, values[part], starts[part], steps)
            for name, measured in windows.measured.items():
                before, after = signals[name][:, place, index], signals[name][:, place, np.minimum(index + 1, last)]
                change = before + windows.share[..., None] * (after - before)
                change = self._pool.layout.displacement(change, measured) if name == "qpos" else change - measured
                with np.errstate(invalid="ignore"):
                    chunk.append(
                        np.where(windows.weight[name] * counts[..., None] > 0, change * windows.weight[name], 0.0)
                    )
            found.append(np.concatenate(chunk, axis=-1).reshape(len(signals["qpos"]), len(index), -1))
        every = np.concatenate(found)
        return np.where(np.isfinite(every).all(axis=(1, 2), keepdims=True), every, np.inf)

    @np.errstate(over="ignore", invalid="ignore")
    def signals(self, windows: Windows, values: np.ndarray, starts: np.ndarray, steps: int | None = None) -> Signals:
        """Return the signals of the same simulations, at the scene's own steps."""
        controls = np.broadcast_to(windows.controls[:, :steps], (len(values), *windows.controls[:, :steps].shape))
        if self._delay is not None:
            at = float(self.scene.model.opt.timestep) * np.arange(controls.shape[2])
            delays = [float(np.ravel(self.coordinates.unravel(one)[self._delay])[0]) for one in values]
            interp = np.vectorize(lambda late, u: np.interp(at - late, at, u), signature="(),(n)->(n)")
            controls = np.moveaxis(interp(np.array(delays)[:, None, None], np.moveaxis(controls, 2, 3)), 3, 2)
        if not self._engine.compiles:
            return self._by_mujoco(windows, values, starts, controls)
        dtype, count = self.scene.data.qpos.dtype, len(values)
        pad = lambda x: jnp.asarray(np.pad(x, [(0, AT_ONCE - count), *[(0, 0)] * (x.ndim - 1)], mode="edge"), dtype)  # noqa: E731
        names = tuple(name for name in windows.measured if name not in STATES)
        state = jax.tree.map(jnp.asarray, windows.state)
        found = self._run(
            ("motions", names), self._simulated, state, pad(values), pad(starts), pad(controls), names=names
        )
        return {name: np.asarray(x, float)[:count] for name, x in found.items()}

    def _by_mujoco(self, windows: Windows, values: np.ndarray, starts: np.ndarray, controls: np.ndarray) -> Signals:
        """Return the signals by C MuJoCo, each model of which makes the motions of all windows."""
        pool, num, each, nsteps = self._pool, *controls.shape[:3]
        state = jax.vmap(lambda one: self._engine.complete(self.scene, one, self._contact))(windows.state)
        rows, numbers = np.tile(pool.template, (each, 1)), self._numbers(values)
        sizes = [pool.layout.sizes[name] for name in ("history", "plugin")]
        parts = dict(zip(("history", "plugin"), np.split(np.asarray(state.history), [sizes[0]], axis=1), strict=True))
        for name in _START:
            rows[:, pool.places[name]] = np.reshape(parts[name] if name in parts else getattr(state, name), (each, -1))
        rest = pool.layout.num_changes - starts.shape[-1]
        rows = pool.layout.moved(rows, np.pad(starts, ((0, 0), (0, 0), (0, rest)))).reshape(num * each, -1)
        user = slice(pool.places["ctrl"].start, pool.places["mocap_quat"].stop)
        given = np.repeat(
            rows[:, None, user], nsteps + 1, axis=1
        )  # one more, whose sensors are those of the last state
        given[:, :, : controls.shape[-1]] = np.pad(controls, ((0, 0), (0, 0), (0, 1), (0, 0)), mode="edge").reshape(
            num * each, nsteps + 1, -1
        )
        with pool.lock, collected():
            models = [with_numbers(pool.plain, {k: x[i] for k, x in numbers.items()}) for i in range(num)]
            every = [model for model in models for _ in range(each)]
            after, sensed = pool.steps.rollout.rollout(
                every, pool.steps.memory, pool.steps.full(rows), given, control_spec=USER,
                initial_warmstart=rows[:, pool.places["warmstart"]],
            )  # fmt: skip
        moved = pool.steps.motions(np.asarray(after)[:, :-1])
        found = {k: np.concatenate([rows[:, None, pool.places[k]], moved[k]], axis=1) for k in STATES}
        for name in windows.measured.keys() - found.keys():
            index = mujoco.mj_name2id(self.scene.mj_model, mujoco.mjtObj.mjOBJ_SENSOR, name)
            begin = self.scene.mj_model.sensor_adr[index]
            found[name] = np.asarray(sensed)[..., begin : begin + self.scene.mj_model.sensor_dim[index]]
        return {name: x.reshape(num, each, *x.shape[1:]) for name, x in found.items()}

    def _numbers(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the numbers of the models that these values change, one row for each."""
        first = jnp.asarray(values[0], self.scene.data.qpos.dtype)
        if "names" not in self._programs:
            self._programs["names"] = sorted(
                jax.eval_shape(lambda v: changed_numbers(self._written(self.scene, v)), first)
            )
        names = tuple(self._programs["names"])
        if not names:
            return {}
        padded = jnp.asarray(np.pad(values, ((0, AT_ONCE - len(values)), (0, 0)), mode="edge"), first.dtype)
        found = self._run(("numbers", names), self._changed, padded, names=names)
        return {name: np.asarray(x, float)[: len(values)] for name, x in found.items()}

    def _changed(self, scene: Scene, values: Array, *, names: tuple[str, ...]) -> dict[str, Array]:
        def one(vector: Array) -> dict[str, Array]:
            found = changed_numbers(self._written(scene, vector))
            return {name: found[name] for name in names}

        return jax.vmap(one)(values)

    def _simulated(
        self, scene: Scene, state: State, values: Array, starts: Array, controls: Array, *, names: tuple[str, ...]
    ) -> dict[str, Array]:
        nv = scene.model.nv

        def observe(model: mjx.Model, data: mjx.Data) -> dict[str, Array]:
            return {name: sensor(model, data, name) for name in names}

        def one(scene: Scene, state: State, start: Array, controls: Array) -> dict[str, Array]:
            qpos = integrate_position(scene.model, state.qpos, start[:nv], 1.0)
            state = eqx.tree_at(lambda s: (s.qpos, s.qvel), state, (qpos, state.qvel + start[nv:]))
            seen = observe if names else None
            course = rollout(scene, state, controls, checkpoint=False, observe=seen, contact=self._contact)
            found = {name: getattr(course, name) for name in STATES} | (course.observations or {})
            return {name: jnp.where(course.diverged, jnp.nan, x) for name, x in found.items()}

        def of_values(vector: Array, starts: Array, controls: Array) -> dict[str, Array]:
            return jax.vmap(functools.partial(one, self._written(scene, vector)))(state, starts, controls)

        return jax.vmap(of_values)(values, starts, controls)

    def _run(self, key: Any, function: Any, *arguments: Any, **static: Any) -> Any:
        """Run a program that takes the scene's arrays as arguments: scenes of equal shapes share it."""
        leaves, tree = jax.tree.flatten(self._arrays)
        key = (*key, *(jnp.shape(leaf) for leaf in jax.tree.leaves(arguments)))
        if key not in self._programs:

            def program(leaves: list[Array], *arguments: Any) -> Any:
                return function(eqx.combine(jax.tree.unflatten(tree, leaves), self._rest), *arguments, **static)

            self._programs[key] = compile_once(jax.jit(program).lower(leaves, *arguments))
        return self._programs[key](leaves, *arguments)
