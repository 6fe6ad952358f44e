"""Error of the derivative of a thrown cube against the time that it takes, by method."""
