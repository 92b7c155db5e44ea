"""A dynamic scene made by the package itself, with exact ground truth for everything."""

from uni4d_fg.synthetic.config import SyntheticSceneConfig
from uni4d_fg.synthetic.noise import CueNoise
from uni4d_fg.synthetic.simulate import Simulation, make_synthetic_sequence, simulate

__all__ = ["CueNoise", "Simulation", "SyntheticSceneConfig", "make_synthetic_sequence", "simulate"]
