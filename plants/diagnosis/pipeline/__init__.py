"""The steps of a diagnosis, each a function from the values of those before it to a value."""
