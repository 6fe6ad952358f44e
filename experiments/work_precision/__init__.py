"""Error against run time, of the motion and of the gradient, over everything a user can set."""
