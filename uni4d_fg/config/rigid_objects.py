"""Configuration of the search for rigid objects."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.solver import KernelConfig, SolverConfig


class RigidObjectsConfig(Section):
    """Which moving instances are rigid, and their poses."""

    enabled: bool = setting(
        False,
        "Search for rigid objects after stage 3. Off by default because of the run time: stage 3 is solved a second "
        "time for the comparison. For energy 'map', and not in windows.",
        basic=True,
    )
    min_tracks: int = setting(8, "An instance with fewer trajectories is not tested: too few to tell.", ge=4)
    min_tracks_per_frame: int = setting(
        3, "A frame that sees fewer tracks of an object does not count as observing it.", ge=3
    )
    min_member_fraction: float = setting(
        0.8,
        "Part of an instance's trajectories that must move with the rigid body: the rest is what masks let in.",
        gt=0.5,
        le=1,
    )
    member_sigmas: float = setting(
        3.0,
        "A trajectory moves with the body if the median of its reprojection errors is at most this many sigmas of the "
        "static scene's noise: a single normal error exceeds it in one case of a hundred.",
        gt=0,
    )
    held_out_fraction: float = setting(
        0.2, "Part of the observations that neither model sees and both predict.", gt=0, le=0.5
    )
    min_advantage_sigmas: float = setting(
        2.0,
        "The rigid model must predict them better than the non-rigid one by this many standard errors; otherwise "
        "the points stay free.",
        ge=0,
    )
    smoothness_prior_frames: float = setting(
        0.01,
        "How smooth a body moves is measured on it; the non-rigid model's sigma counts as much as this many frames.",
        gt=0,
    )
    kernel: KernelConfig = setting(KernelConfig(kind="huber", threshold=1.345), "Kernel of every term.")
    solver: SolverConfig = setting(SolverConfig(relative_decrease=1e-6), "Solver of each body.")
    seed: int = setting(0, "Seed of the choice of held-out observations.", ge=0)
