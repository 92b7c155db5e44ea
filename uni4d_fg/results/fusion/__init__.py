"""Dense depth that agrees with the sparse points, and the 4D cloud."""
