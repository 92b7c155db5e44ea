"""The baseline: the same stages and the same residual functions, minimized by Adam in PyTorch.

This is how the authors of Uni4D optimize. PyTorch is an optional dependency (``pip install 'uni4d-fg[adam]'``),
imported when a solve begins.
"""
