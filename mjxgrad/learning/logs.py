"""Where the numbers of a run go: each function here returns a `log(step, metrics)` for `learn` and `mg.optimise`."""

import csv
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

Log = Callable[[int, dict[str, float]], Any]


def to_csv(path: str | os.PathLike[str]) -> Log:
    """Write a row per call, headed by the names of the first; a file that is there is gone on with.

    Raises:
        ValueError: when called with other names than those in the file.
    """
    path = Path(path)

    def log(step: int, metrics: dict[str, float]) -> None:
        names = ["step", *metrics]
        is_new = not path.exists() or not path.stat().st_size
        if not is_new:
            with path.open(newline="", encoding="utf-8") as file:
                there = next(csv.reader(file))
            if there != names:
                raise ValueError(
                    f"{path} must have the columns {', '.join(names)}, got {', '.join(there)}: name another"
                )
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            if is_new:
                writer.writerow(names)
            writer.writerow([step, *metrics.values()])

    return log


def to_tensorboard(folder: str | os.PathLike[str]) -> Log:
    """Write scalars that TensorBoard shows.

    Raises:
        ImportError: if tensorboardX is not installed.
    """
    try:
        tensorboard: Any = importlib.import_module("tensorboardX")
    except ImportError as error:
        raise ImportError("to_tensorboard needs tensorboardX, not installed: pip install 'mjxgrad[logs]'") from error
    writer = tensorboard.SummaryWriter(str(folder))

    def log(step: int, metrics: dict[str, float]) -> None:
        for name, value in metrics.items():
            writer.add_scalar(name, value, step)
        writer.flush()

    return log


def to_tracker(run: Any) -> Log:
    """Hand everything to a run of wandb, trackio or another with their `run.log(metrics, step=...)`."""
    return lambda step, metrics: run.log(dict(metrics), step=step)


def to_all(*logs: Log) -> Log:
    """Call several."""

    def log(step: int, metrics: dict[str, float]) -> None:
        for one in logs:
            one(step, metrics)

    return log
