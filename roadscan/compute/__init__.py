"""Array computations that all features share: robust scatter, runs of flags, distances along places."""
