"""The rolling pin: ways to find a contact that is not there yet."""
