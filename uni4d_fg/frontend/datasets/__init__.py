"""The field's datasets as they come from their makers: which videos, which frames, what truth; one file per dataset."""
