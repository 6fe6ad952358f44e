"""The derivative of a bounce over contact parameters and time steps, against its closed form."""
