"""The estimators that a method's settings name."""

import functools

from experiments.optimisation.settings import MethodSettings
from mjxgrad import estimators
from mjxgrad.estimators import rules

_RULES = {
    "least_risk": rules.LeastRisk,
    "inverse_variance": rules.InverseVariance,
    "concavity": rules.Concavity,
    "trust_region": rules.TrustRegion,
}


def estimator(method: MethodSettings, gamma: float = 0.0, bound: float = 0.0) -> functools.partial:
    """Return an estimator, its options bound; the rule "bias_constrained" takes the published constants of a task."""
    options = method.options
    if method.rule is not None:
        is_published = method.rule == "bias_constrained"
        options["rule"] = rules.BiasConstrained(gamma, bound) if is_published else _RULES[method.rule]()
    return functools.partial(getattr(estimators, method.name), **options)
