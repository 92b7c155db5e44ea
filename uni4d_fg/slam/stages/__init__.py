"""The three stages: which terms and kernels each has, which variables are free, and how it is solved from tracks."""
