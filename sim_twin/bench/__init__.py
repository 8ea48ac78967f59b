"""The benchmark: the paper's 81 scenarios in the twin, for any method, object and seed."""
