"""The experiment on smoothing kernels: it samples the library's densities, and says what was measured."""

import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.kernels import KERNELS, Kernel, Outcome, Settings, answer, drawings, measure, tables, verdict
from experiments.theme import save
from experiments.workspace import Workspace

SETTINGS = Settings(experiment="kernels", length=4e-3, num_samples=200, gaps=(0.1, 0.3))


def kernel(off, misses):
    """Forces of 1 N, whose means are off by so many standard errors at one distance."""
    means = np.stack([np.ones(13), np.full(13, 0.1)])
    means[0, 3] += 0.1 * off
    return Kernel(np.ones(121), np.stack([np.ones(31), -np.ones(31)]), means, np.array(misses))


def outcome(off=1.5):
    kernels = [kernel(1.0, [0.01, 0.15]), kernel(-off, [0.15, 0.15]), kernel(0.5, [0.01, 0.01])]
    return Outcome(SETTINGS, dict(zip(KERNELS, kernels, strict=True)), np.zeros(121))


@pytest.mark.parametrize("name", list(KERNELS))
def test_samples_are_of_the_density_that_the_library_tells(name):
    w = np.linspace(-5, 5, 11)
    density = mg.Smoothing(1.0, kernel=name).density(jnp.asarray(w))
    np.testing.assert_allclose(KERNELS[name][2].pdf(w), density, rtol=1e-12)


def test_the_answer_tells_agreement_and_from_where_pushes_are_found(tmp_path):
    found = outcome()
    assert answer(found) == "Samples agree; pushes found from 0.1 (Gaussian), 0 (logistic) and 0.3 (log barrier) m."
    assert answer(outcome(6.0)).startswith("Samples disagree")
    assert "within 1.5 standard errors" in verdict(found)
    assert len(tables(found)[0].rows) == 3
    assert len(save(drawings(found), tmp_path)) == 1


@pytest.mark.slow
def test_every_law_is_the_mean_of_samples(tmp_path):
    found = measure(SETTINGS.model_copy(update={"gaps": ()}), Workspace(tmp_path))
    assert found.off < 5
    assert all(one.near.shape == (121,) and np.all(one.far[1] < 0) for one in found.kernels.values())
