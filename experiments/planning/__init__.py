"""Plans through contact on smoothed linear models."""
