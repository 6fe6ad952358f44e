"""What the experiment on billiards can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import Positive, RunSettings, SettingsTable


class MethodSettings(SettingsTable):
    """One way to descend, from one start."""

    label: str
    """In legends and tables."""
    estimator: Literal["first_order", "zeroth_order", "alpha_order"] = "first_order"
    """Of `mjxgrad.estimators`."""
    gradient: Literal["discrete", "event"] = "discrete"
    """Derivative of the steps."""
    start: Positive = 1.3
    """Constant force of the start, in N along each axis; below 1.43 the balls do not touch."""
    stddev: Positive = 1e-6
    """Of the noise on each piece of the force at the start, in N; the default is none to speak of."""
    num_samples: Annotated[int, Field(ge=2)] = 2
    """Rollouts per step."""
    margin: Positive | None = None
    """By what the contact begins earlier at the start, in m."""
    length: Positive | None = None
    """Of the noise on the distance that the solver averages over at the start, in m."""

    @model_validator(mode="after")
    def _check(self) -> "MethodSettings":
        if self.margin is not None and self.length is not None:
            raise ValueError("margin and length must not be set both")
        return self


class Settings(RunSettings):
    """Cost against steps of several descents on the same stroke."""

    methods: Annotated[tuple[MethodSettings, ...], Field(min_length=1, max_length=10)]
    """In the order of the legend."""
    num_steps: Annotated[int, Field(ge=10)] = 80
    """Of each descent."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        labels = [method.label for method in self.methods]
        if len(set(labels)) < len(labels):
            raise ValueError("labels of methods must differ")
        return self
