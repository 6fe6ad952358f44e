"""What an experiment on a textbook problem can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import Finite, Positive, RunSettings, SettingsTable

Count = Annotated[int, Field(ge=2)]


class EstimatorSettings(SettingsTable):
    """One estimator, with what is set of its options."""

    name: str
    """Of a function in `mjxgrad.estimators`."""
    baseline: Literal["leave_one_out", "zero_noise", "none"] | None = None
    """Of the zeroth-order part; the estimator's own default if it is not set."""
    antithetic: bool | None = None
    """Whether noise is used in pairs."""
    rule: Literal["consistent", "inverse_variance", "concavity"] | None = None
    """How alpha_order chooses its weight; the rules that need no number of the user."""

    @property
    def label(self) -> str:
        """Give a name for legends and tables."""
        parts = []
        if self.baseline is not None:
            parts.append(self.baseline.replace("_", " ") if self.baseline != "none" else "no baseline")
        parts += ["pairs"] if self.antithetic else []
        parts += [self.rule.replace("_", " ")] if self.rule else []
        return self.name.replace("_", " ") + (f" ({', '.join(parts)})" if parts else "")


class Settings(RunSettings):
    """Error, bias and variance of estimators against samples and stiffness, with closed forms drawn in."""

    problem: Literal["heaviside", "soft_heaviside", "quadratic_sine"]
    """The cost, a function of `mjxgrad.tasks.textbook`."""
    point: Finite
    """Where the gradient is estimated."""
    stddev: Positive
    """Of the noise."""
    estimators: Annotated[tuple[EstimatorSettings, ...], Field(min_length=1, max_length=10)]
    """In the order of the legend."""
    num_samples: Annotated[tuple[Count, ...], Field(min_length=2)]
    """Rollouts per estimate, all that an estimator spends included, for error against rollouts."""
    num_repeats: Count = 400
    """Estimates of each estimator at each setting."""
    stiffness: tuple[Positive, ...] = ()
    """To sweep: 1/width of the soft step, or the frequency of the sine."""
    shown_stiffness: Positive | None = None
    """At which error against rollouts is measured."""
    samples_at_stiffness: Count = 100
    """Rollouts per estimate in the sweep of stiffness."""
    amplitude: Positive = 0.1
    """Of the sine."""
    missed_samples: Annotated[int, Field(ge=10)] = 500
    """First-order samples from which the chance to miss the slope is estimated (soft step only)."""
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.95
    """Of every interval."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.problem == "heaviside" and (self.stiffness or self.shown_stiffness):
            raise ValueError("stiffness and shown_stiffness must not be set: a step has none; take soft_heaviside")
        if self.problem != "heaviside" and (len(self.stiffness) < 2 or self.shown_stiffness is None):
            raise ValueError(f"{self.problem} needs at least two values of stiffness, and shown_stiffness")
        labels = [estimator.label for estimator in self.estimators]
        if repeated := {label for label in labels if labels.count(label) > 1}:
            raise ValueError(f"estimators must differ, got {', '.join(sorted(repeated))} more than once")
        return self
