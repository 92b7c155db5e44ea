"""The three stages as declarations: which terms, which kernels, which variables are free."""
