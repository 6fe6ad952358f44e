"""First-order control and policy gradients, discrete and event, against an unbiased reference."""
