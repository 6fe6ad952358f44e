"""What continuous onset, the event gradient and smoothing cost: ratios to the plain step and its gradient, in one process.

    python -m experiments.costs [--batch 256] [--repeats 7] [--only onset]

Every case is compiled first; then all take turns, so that a change of the machine's load meets all alike.
"""

import argparse
import functools
import time
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import mjxgrad as mg

_HOPPER = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "hopper.xml"
# By name: the scene, and from how high above contact it starts (m), as index in qpos and height.
_SCENES = {
    "two_bodies": (Path(__file__).parents[1] / "mjcf" / "two_bodies.xml", (2, 0.02)),
    "hopper (RK4)": (_HOPPER, (1, 0.05)),
}
_NUM_STEPS = 100


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--only", default="", help="word that cases must hold, besides the plain ones")
    arguments = parser.parse_args()
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, batch {arguments.batch}, {_NUM_STEPS} steps")
    for name, (path, start) in _SCENES.items():
        _measure(name, path, start, arguments)


def _measure(name: str, path: Path, start: tuple[int, float], arguments: argparse.Namespace) -> None:
    scene = mg.load_scene(path)
    qpos = scene.data.qpos.at[start[0]].add(start[1])
    qvel = 0.3 * jax.random.normal(jax.random.key(0), (arguments.batch, scene.model.nv))

    def cost(qvel, **settings):
        state = mg.initial_state(scene, qpos=qpos, qvel=qvel)
        return jnp.sum(mg.rollout(scene, state, horizon=_NUM_STEPS, **settings).qpos[-1] ** 2)

    def reverse(qvel, **settings):
        return jax.value_and_grad(functools.partial(cost, **settings))(qvel)

    def forward(qvel, **settings):
        return jax.jvp(functools.partial(cost, **settings), (qvel,), (jnp.ones_like(qvel),))

    smooth, behind = mg.Smoothing(1e-3), mg.Smoothing(1e-3, mode="backward")
    cases = {
        "rollout": (cost, {}),
        "rollout, onset": (cost, {"onset": mg.Onset()}),
        "rollout, smoothed": (cost, {"smoothing": smooth}),
        "value_and_grad": (reverse, {}),
        "value_and_grad, onset": (reverse, {"onset": mg.Onset()}),
        "value_and_grad, event": (reverse, {"gradient": "event"}),
        "value_and_grad, smoothed": (reverse, {"smoothing": smooth}),
        "value_and_grad, smoothed backward": (reverse, {"smoothing": behind}),
        "jvp": (forward, {}),
        "jvp, onset": (forward, {"onset": mg.Onset()}),
        "jvp, event": (forward, {"gradient": "event"}),
    }
    cases = {case: how for case, how in cases.items() if "," not in case or arguments.only in case}
    programs = {case: jax.jit(jax.vmap(functools.partial(f, **settings))) for case, (f, settings) in cases.items()}
    seconds = {case: [] for case in programs}
    for turn in range(arguments.repeats + 1):
        for case, program in programs.items():
            began = time.perf_counter()
            jax.block_until_ready(program(qvel))
            if turn:
                seconds[case].append(time.perf_counter() - began)
    for case, times in seconds.items():
        base = float(np.median(seconds[case.split(",")[0]]))
        low, middle, high = (1e3 * float(q) for q in np.quantile(times, [0, 0.5, 1]))
        print(
            f"{name:14} {case:34} {middle:8.1f} ms ({low:.1f} to {high:.1f})  ratio {middle / 1e3 / base:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
