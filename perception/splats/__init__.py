"""Finished Gaussian scenes of other tools as inputs of `map`: read, looked at by virtual cameras, and given back."""
