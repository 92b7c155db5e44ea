"""The scores of the literature, each by its name, as the programs behind published tables compute them."""
