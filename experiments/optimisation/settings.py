"""What an optimisation experiment can be told; imports nothing heavy."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from experiments.settings import Confidence, OwnScene, Positive, RunSettings, SettingsTable, Several

SEARCHES = ("cross_entropy", "mppi", "predictive_sampling")

_NAMES = {"mppi": "MPPI", "reinforce": "REINFORCE", "cross_entropy": "cross-entropy", "alpha_order": "α-order"}


class MethodSettings(SettingsTable):
    """One method, with what is set of its options: an estimator for gradient descent, or a search."""

    # Of a function in `mjxgrad.estimators` or in `searches.py`.
    name: Literal[
        "first_order", "zeroth_order", "least_squares", "control_variate", "alpha_order", "reinforce",
        "per_step_inverse_variance", "cross_entropy", "mppi", "predictive_sampling",
    ]  # fmt: skip
    # Of zeroth order and REINFORCE; their own default if it is not set.
    baseline: Literal["leave_one_out", "zero_noise", "none"] | None = None
    antithetic: bool | None = None  # whether zeroth order uses noise in pairs
    # How alpha_order chooses its weight; bias_constrained takes the published constants of the task.
    rule: Literal["least_risk", "inverse_variance", "concavity", "trust_region", "bias_constrained"] | None = None
    control_variate: bool | None = None  # whether the unbiased part of alpha_order uses derivatives
    # Width of a search, in the parameters' units; without it, the noise on the controls if they are the parameters.
    stddev: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> "MethodSettings":
        takes = {
            "baseline": ("zeroth_order", "reinforce"),
            "antithetic": ("zeroth_order",),
            "rule": ("alpha_order",),
            "control_variate": ("alpha_order",),
            "stddev": SEARCHES,
        }
        if wrong := [key for key in sorted(self.model_fields_set - {"name"}) if self.name not in takes[key]]:
            raise ValueError(f"{self.name} takes no {', '.join(wrong)}")
        return self

    @property
    def is_search(self) -> bool:
        """Say whether the method moves by itself, without a gradient."""
        return self.name in SEARCHES

    @property
    def is_baseline(self) -> bool:
        """Say whether this is what one would otherwise use."""
        return self.is_search or self.name == "reinforce"

    @property
    def is_default_alpha(self) -> bool:
        """Say whether this is α-order as it comes."""
        return self.name == "alpha_order" and self.options == {}

    @property
    def options(self) -> dict[str, Any]:
        """Give what is set for an estimator."""
        return self.model_dump(include={"baseline", "antithetic", "rule", "control_variate"}, exclude_none=True)

    @property
    def label(self) -> str:
        """Give a name for legends and tables."""
        parts = [self.rule.replace("_", " ")] if self.rule else []
        if self.baseline is not None:
            parts.append(self.baseline.replace("_", " ") if self.baseline != "none" else "no baseline")
        parts += ["pairs"] if self.antithetic else []
        if self.control_variate is not None:
            # A rule of the literature mixes with plain zeroth order; said where it is not so.
            is_usual = self.control_variate == (self.rule in (None, "least_risk"))
            parts += [] if is_usual else ["with control variate" if self.control_variate else "no control variate"]
        elif self.rule not in (None, "least_risk"):
            parts.append("with control variate")
        parts += [f"width {self.stddev:g}"] if self.stddev else []
        name = _NAMES.get(self.name, self.name.replace("_", " "))
        return name + (f" ({', '.join(parts)})" if parts else "")


class Settings(OwnScene, RunSettings):
    """A task, optimised by several methods from the same start at equal rollouts, over many seeds."""

    # What is optimised; see `experiments.optimisation.published`. A scene of one's own, by its controls, takes its place.
    task: Literal["push_soft", "push_stiff", "friction", "tennis", "motion_planning", "lqr"] | None = None
    stddev: Positive = 0.1  # of the noise on each control of an own scene, in halves of its range
    methods: Annotated[tuple[MethodSettings, ...], Field(min_length=2, max_length=14)]  # in the order of the table
    seeds: Several = 10  # runs of each method, in one program
    num_steps: Annotated[int, Field(ge=1)] | None = None  # of each run; without it, as many as published
    # Rollouts per step, all that a method spends included; without it, as many as published.
    num_samples: Several | None = None
    learning_rate: Positive | None = None  # of plain gradient descent; without it, as published
    evaluations: Annotated[int, Field(ge=1)] = 50  # how often the cost without noise is measured on the way
    confidence: Confidence = 0.95  # of every interval

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.task is None and self.scene is None:
            raise ValueError("task: required where there is no scene, and missing")
        if self.scene is not None and self.learning_rate is None:
            raise ValueError("learning_rate: required with a scene of one's own, and missing; in control² per cost")
        return self
