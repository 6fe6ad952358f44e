"""First-order control and policy gradients, MuJoCo's step and continuous onset, against an unbiased reference."""
