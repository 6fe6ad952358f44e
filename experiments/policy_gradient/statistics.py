"""Norms, angles and errors of vectors that are known from independent estimates only."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Vectors = Float[np.ndarray, "estimates dim"]


def squared_norm(vectors: Vectors) -> float:
    r"""Give the squared norm of the mean without bias.

    That of the average holds the noise, too: with 200 coordinates more noise than signal. The mean of $x_i \cdot x_j$ over
    different $i$ and $j$ does not.

    Args:
        vectors: independent estimates of one vector, at least 2.

    Returns:
        Its squared norm; below zero if noise is all there is.
    """
    count = len(vectors)
    return float((np.sum(vectors.sum(axis=0) ** 2) - np.sum(vectors**2)) / (count * (count - 1)))


def squared_distance(first: Vectors, reference: Vectors) -> float:
    """Give the squared distance of two means, of independent estimates, without bias."""
    return squared_norm(first) + squared_norm(reference) - 2 * float(first.mean(axis=0) @ reference.mean(axis=0))


def share_along(first: Vectors, reference: Vectors) -> float:
    """Give the component of a mean along another, as a share of that one's length; NaN where that is not known from zero."""
    square = squared_norm(reference)
    return float(first.mean(axis=0) @ reference.mean(axis=0)) / square if square > 0 else np.nan


def cosine(first: Vectors, reference: Vectors) -> float:
    """Give the cosine of the angle between two means; NaN where one of them is not known from zero."""
    squares = squared_norm(first) * squared_norm(reference)
    inner = float(first.mean(axis=0) @ reference.mean(axis=0))
    return inner / np.sqrt(squares) if squares > 0 else np.nan


def relative_squared_distance(first: Vectors, reference: Vectors) -> float:
    """Give the squared distance of two means over the squared norm of the second; NaN where that is not known from zero."""
    square = squared_norm(reference)
    return squared_distance(first, reference) / square if square > 0 else np.nan


def jackknife_error(function: Callable[..., float], *sets: Vectors) -> float:
    """Give the standard error of a function of several sets of independent estimates.

    Args:
        function: of all sets.
        *sets: independent of each other.

    Returns:
        The jackknife's error: each estimate of each set is left out once.

    References:
        Efron, Tibshirani. An Introduction to the Bootstrap. Chapman & Hall 1993, section 11.5.
    """
    variance = 0.0
    for i, vectors in enumerate(sets):
        count = len(vectors)
        without = [function(*sets[:i], np.delete(vectors, j, axis=0), *sets[i + 1 :]) for j in range(count)]
        variance += (count - 1) * float(np.var(without))
    return variance**0.5
