"""A dynamic scene made by the package itself, with exact ground truth for everything."""

from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.synthetic.simulate import Simulation, make_synthetic_sequence, simulate

__all__ = ["CueNoise", "Simulation", "SyntheticSceneConfig", "make_synthetic_sequence", "simulate"]
