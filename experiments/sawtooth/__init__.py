"""The sawtooth of a simulated outcome, and what is left of it when contacts begin within the step."""
