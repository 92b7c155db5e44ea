"""Scores of a result against ground truth; every number names the protocol it was computed with."""
