"""The mathematics of the gradient tensor: geometry, assembly, invariants; plain numpy, no recipes."""
