"""Pictures of a result: camera path, depth strip, views of the 4D cloud."""

from uni4d_fg.results.pictures.depth_strip import draw_depth_strip
from uni4d_fg.results.pictures.scene import draw_scene
from uni4d_fg.results.pictures.trajectory import draw_trajectory

__all__ = ["draw_depth_strip", "draw_scene", "draw_trajectory"]
