"""Variables and their GTSAM keys, and problems made of factor batches."""
