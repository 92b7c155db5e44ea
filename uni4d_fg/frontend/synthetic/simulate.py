"""From a configuration to a sequence with ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray, Int32Array
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.synthetic.camera_path import camera_path
from uni4d_fg.frontend.synthetic.noise import noisy_depths, noisy_masks, noisy_tracks
from uni4d_fg.frontend.synthetic.raycast import RayCaster
from uni4d_fg.frontend.synthetic.render import render_frame
from uni4d_fg.frontend.synthetic.scene import Scene, make_scene
from uni4d_fg.frontend.synthetic.tracks import ExactTracks, SurfacePoints, TrackFollower, pick_points, query_grid
from uni4d_fg.geometry.lens import Lens

_FLAT_GRAY = np.uint8(128)


@dataclass(frozen=True)
class Simulation:
    """A sequence with noisy cues, and the truth that a :class:`GroundTruth` has no field for."""

    sequence: Sequence
    """What a reconstruction gets, with its ground truth."""
    tracks: ExactTracks
    """The same tracks without noise, with their instance ids."""
    masks: Int32Array
    """(T, H, W) exact instance ids."""
    depth_log_scale: FloatArray
    """(T,) each frame's depth cue times ``exp`` of this is the true depth, up to field and pixel noise."""


def simulate(
    config: SyntheticSceneConfig, scene: Scene | None = None, world_T_cam: FloatArray | None = None
) -> Simulation:
    """Build the scene, render it, follow its tracks and add noise.

    Args:
        config: What to make.
        scene: Another world than the configuration's room and objects.
        world_T_cam: (T, 4, 4) another path than the configuration's.

    Raises:
        MissingDependencyError: If Open3D cannot be loaded.
    """
    image_size = (config.height, config.width)
    intrinsics = np.array(
        [config.focal, config.focal, 0.5 * (config.width - 1), 0.5 * (config.height - 1)], dtype=np.float64
    )
    lens = Lens(config.camera_model, config.distortion)
    timestamps = np.arange(config.num_frames) / config.frame_rate
    if world_T_cam is None:
        world_T_cam = camera_path(config.path, timestamps, config.camera_speed)
    if scene is None:
        scene = make_scene(config.objects, config.objects_per_kind, config.object_scale)

    depths = np.empty((config.num_frames, *image_size), dtype=np.float32)
    masks = np.empty((config.num_frames, *image_size), dtype=np.int32)
    images: ImageArray = np.broadcast_to(_FLAT_GRAY, (config.num_frames, *image_size, 3))
    if config.render_images:
        images = np.empty((config.num_frames, *image_size, 3), dtype=np.uint8)
    grid = query_grid(image_size, config.grid_columns, config.grid_rows, config.margin_px)
    picked: list[SurfacePoints] = []
    casters: list[RayCaster] = []
    for t in range(config.num_frames):
        vertices = scene.vertices(timestamps[t])
        caster = RayCaster(vertices, scene.triangles)
        casters.append(caster)
        frame = render_frame(
            scene, vertices, caster, world_T_cam[t], intrinsics, image_size, config.render_images, lens
        )
        depths[t], masks[t] = frame.depth, frame.instance
        if frame.image is not None:
            images[t] = frame.image
        if t % config.query_interval == 0:
            picked.append(pick_points(caster, world_T_cam[t], intrinsics, grid, t, lens))

    follower = TrackFollower(
        SurfacePoints.concatenate(picked),
        scene.triangles,
        scene.triangle_instance,
        world_T_cam,
        intrinsics,
        image_size,
        lens,
    )
    for t, caster in enumerate(casters):
        follower.add_frame(t, scene.vertices(timestamps[t]), caster)
    exact = follower.finish()
    rigid_instance, world_T_object = scene.rigid_poses(timestamps)

    cue, depth_log_scale = noisy_depths(depths, config.noise, config.seed)
    wrong_focal = np.array([1.0 + config.noise.focal_error] * 2 + [1.0, 1.0])
    sequence = Sequence(
        name="synthetic",
        images=ArrayFrames(images),
        depths=ArrayFrames(cue),
        masks=ArrayFrames(noisy_masks(masks, config.noise, config.seed)),
        intrinsics=intrinsics * wrong_focal,
        image_size=image_size,
        timestamps=timestamps,
        frame_names=tuple(f"{t:05d}" for t in range(config.num_frames)),
        tracks=noisy_tracks(exact, config.noise, image_size, config.seed),
        ground_truth=GroundTruth(
            world_T_cam=world_T_cam,
            depths=ArrayFrames(depths),
            masks=ArrayFrames(masks),
            intrinsics=intrinsics,
            track_points=exact.points,
            rigid_instance=rigid_instance,
            world_T_object=world_T_object,
        ),
    )
    return Simulation(sequence, exact, masks, depth_log_scale)


def make_synthetic_sequence(config: SyntheticSceneConfig | None = None) -> Sequence:
    """Make a sequence with noisy cues, long tracks and full ground truth, all in memory.

    Args:
        config: What to make; None takes the defaults.

    Raises:
        MissingDependencyError: If Open3D cannot be loaded.
    """
    return simulate(config if config is not None else SyntheticSceneConfig()).sequence
