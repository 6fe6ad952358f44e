"""Print how large the house is: files, lines, words of the front page, public names, frames from `optimise` to the solve.

Run it by .venv/bin/python .ci/house.py.
"""

import sys
import traceback
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))


class ReachedError(Exception):
    """Raised where the solve begins, to read the stack there."""


def frames() -> int:
    """Return how many frames of the library lie between the README's `optimise` and Newton's iteration."""
    import functools

    import jax
    import jax.numpy as jnp
    import optax

    import mjxgrad as mg
    from mjxgrad.solver import newton

    def reached(*_, **__):
        raise ReachedError

    newton.minimise = reached
    task = mg.tasks.ball_wall()
    estimator = functools.partial(mg.estimators.alpha_order, num_samples=4)
    try:
        mg.optimise(
            task.objective(stddev=0.1),
            jnp.array([0.5]),
            jax.random.key(0),
            estimator=estimator,
            optimiser=optax.adam(0.01),
            num_steps=1,
        )
    except ReachedError as error:
        library = str(ROOT / "mjxgrad")
        return sum(frame.filename.startswith(library) for frame in traceback.extract_tb(error.__traceback__))
    raise RuntimeError("the solve was not reached")


def main() -> None:
    """Print the table."""
    for part in ("mjxgrad", "experiments", "tests"):
        files = list((ROOT / part).rglob("*.py"))
        lines = sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)
        print(f"{part:12} {len(files):4} files {lines:6} lines")
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    print(f"README.md    {len(page.splitlines()):4} lines {len(page.split()):6} words")
    import mjxgrad

    print(f"public names {len(mjxgrad.__all__):4}")
    print(f"frames from optimise to the solve {frames()}")


if __name__ == "__main__":
    main()
