"""Where the step is stable, and where its gradient is."""
