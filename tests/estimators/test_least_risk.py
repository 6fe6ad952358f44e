"""The default rule beside the least worst case that any rule of both means can have, for normal noise of equal coordinates.

Let zeroth order have variance 1, and first order variance v and bias b, in each of p coordinates. All that both means tell of b
is their difference, of variance 1 + v. An estimate adds a function of it to zeroth order, whose best choice for a prior of |b|
is known. What the best loses under any prior, over the better part's error, no rule can undercut for all biases.
"""

import jax
import numpy as np
import pytest
from scipy import special, stats

from mjxgrad.estimators import rules
from tests.estimators.test_rules import evidence

ROUNDS = 600  # of a game between a prior and its best estimate
BIASES, LENGTHS = 100, 500


CASES = [(1, 0.3), (1, 0.1), (1, 0.01), (1, 1e-3), (1, 1e-4), (2, 0.03), (4, 0.01), (4, 1e-4), (16, 0.1), (64, 1e-4)]


@pytest.mark.parametrize(("dim", "noise"), CASES)
def test_no_rule_of_both_means_has_a_worst_case_much_better(dim, noise):
    scale = np.sqrt(1 + noise)  # of the difference, in which biases and lengths are
    most = 3 * np.sqrt(dim) + 6
    bias = np.concatenate([[0], np.geomspace(0.02, most, BIASES)])[:, None]
    length = np.linspace(1e-3, most + np.sqrt(dim) + 8, LENGTHS)
    density = 2 * length * stats.ncx2.pdf(length**2, dim, np.maximum(bias, 1e-8) ** 2) * (length[1] - length[0])
    reach = np.maximum(bias, 1e-8) * length
    along = special.ive(dim / 2, reach) / np.maximum(special.ive(dim / 2 - 1, reach), 1e-300)
    better = np.minimum(dim * noise + (scale * bias[:, 0]) ** 2, dim)

    def over_better(found):
        """Return the error of an estimate that finds so much bias, over the better part's, at each bias."""
        missed = (density * (found**2 - 2 * found * bias * along + bias**2)).sum(axis=1)
        return (dim * noise + missed) / scale**2 / better

    prior, least = np.full(BIASES + 1, 1 / (BIASES + 1)), 0.0
    for number in range(ROUNDS):
        weights = prior / better
        best = (weights * bias[:, 0]) @ (density * along) / np.maximum(weights @ density, 1e-300)
        ratios = over_better(best)
        least = max(least, prior @ ratios)
        prior = prior * np.exp(0.5 / np.sqrt(1 + number / 50) * (ratios - ratios.max()))
        prior /= prior.sum()

    seen = scale**2 * (length**2 - dim)
    facts = {"squared_bias": seen, "squared_bias_error": scale**2 * np.sqrt(2 * dim), "noise_dim": float(dim)}
    facts |= {
        "zeroth_noise": float(dim),
        "first_noise": dim * noise,
        "count": 1e12,
        "squared_jump_bound": 0.0,
        "squared_bias_bound": 1e9,
    }
    alpha = np.asarray(jax.vmap(rules.LeastRisk())(evidence(**facts)).alpha)
    worst = over_better(length * (1 - scale**2 * alpha)).max()
    assert worst >= least * (1 - 1e-3)  # as nothing else can be; sums stand for integrals
    assert worst <= 1.25 * least
