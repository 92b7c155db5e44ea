"""Depth from camera motion alone: structure from motion, scaled by convention, interpolated to maps.

Nothing in the images says how large the world is. The result is scaled so that the median depth of the static
points in the first frame is ``geometric_depth.median_depth``; it is not metric. A camera that stays in one
place shows no depth at all: it is given a sphere of that radius, with a warning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray, rows_by_group
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.config.models import Config
from uni4d_fg.counted import counted
from uni4d_fg.cues.borrowed_points import beside_masks, with_borrowed
from uni4d_fg.cues.camera_noise import CameraNoise
from uni4d_fg.cues.ground_plane import Ground, find_ground
from uni4d_fg.cues.interpolated_depth import (
    InterpolatedDepths,
    SparseInverseDepth,
    enlarged,
    ground_contact,
    smooth_over_time,
    supported,
)
from uni4d_fg.cues.moving_things import Sightings, place_moving
from uni4d_fg.cues.parts_of_things import feet_of, things_below
from uni4d_fg.cues.start_doubts import start_doubts, start_summary
from uni4d_fg.cues.structure.motion import (
    Structure,
    observations_of_tracks,
    rotations_only,
    structure_from_motion,
)
from uni4d_fg.cues.structure.rotation_focal import focal_of_rotations
from uni4d_fg.cues.structure.search import StartCameras
from uni4d_fg.cues.structure.triangulation import inverse_depth_sigma
from uni4d_fg.cues.through_ground import tracks_through
from uni4d_fg.errors import DegenerateProblemError, InputError
from uni4d_fg.frontend.sequence.calibration import unusual_focal
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import NEAR_PLANE, project, world_to_camera
from uni4d_fg.geometry.se3 import so3_log
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

_SEEN_OFTEN = 5
"""Points that so many frames see are used in those that do not."""
_SPHERE_STEP = 16
"""Spacing of the nodes between which a sphere is interpolated, px."""


@dataclass(frozen=True)
class GeometricDepth:
    """Cameras and depth up to scale."""

    depths: FrameSource[Float32Array]
    """T maps (H, W), in the unit of the result; every pixel has a value."""
    world_T_cam: FloatArray
    """(T, 4, 4); the first camera is the world."""
    camera: CameraModel
    """Intrinsics, lens and zoom."""
    sparse: Float32Array
    """(K, T) depth of every static observation that is triangulated well, NaN elsewhere."""
    moving: BoolArray
    """(K,) tracks that contradict a static scene."""
    stray: BoolArray
    """(K, T) observations of another static surface than most of their track."""
    has_parallax: bool
    """False if the camera stays in one place, so that depth is a convention."""
    focal_sigma: float
    """Standard deviation of the log of the focal lengths that were found; 0 for those that were held."""
    facts: tuple[str, ...]
    """What was found, one line each."""
    warnings: tuple[str, ...]
    """What to distrust besides the scale, which is never metric; one line each."""
    is_read_at_once: bool = True
    """False if the tracks ask for a rolling shutter."""
    start: dict[str, Any] = field(default_factory=dict)
    """What the motion leaves open, for the summary of a run: ``focal_interval_px`` (95 %), ``stretch_along_view`` (by
    which factors depth and motion along the viewing direction may be wrong), ``unexplained`` (part of the held-out
    tracks), ``registered`` (part of the frames), ``starts`` (those that explain the tracks nearly as well)."""

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) px."""
        return self.camera.intrinsics


def depth_from_motion(
    video: Video,
    tracks: Tracks,
    is_static: BoolArray,
    intrinsics: FloatArray,
    config: Config,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
    with_doubts: bool = True,
    camera: CameraModel | None = None,
    start: StartCameras | None = None,
) -> GeometricDepth:
    """Find cameras and up-to-scale depth from tracks of the static scene.

    Args:
        video: Image size, and masks of what moves if there are any: their pixels get the depth at which the
            thing stands on the static scene.
        tracks: K tracks.
        is_static: (K,) which tracks to use. Some may move all the same, as long as most do not.
        intrinsics: (4,) px; kept when ``config.input.intrinsics`` is 'fixed', else a starting value.
        config: Sections ``geometric_depth``, ``bundle_adjustment`` and ``input``.
        reporter: Progress.
        should_stop: Polled often.
        with_doubts: Also look for what the motion leaves open; not needed of what only leads to masks.
        camera: A lens or a zoom that is known, with the intrinsics to start from, or a pinhole if there is none; None
            looks for one, and for a rolling shutter, as section ``camera`` says. A zoom is taken if these
            tracks ask for one, too.
        start: Cameras that were found before; they are taken where they explain the tracks best.

    Raises:
        InputError: If tracks, video and ``is_static`` do not fit each other.
        DegenerateProblemError: If there are no static tracks to speak of.
        SolverError: If bundle adjustment fails.
        Cancelled: If ``should_stop`` turned true.
    """
    reporter, should_stop = reporter or SilentReporter(), should_stop or (lambda: False)
    if tracks.num_frames != video.num_frames or is_static.shape != (tracks.num_tracks,):
        raise InputError(
            f"depth from motion: {tracks.num_tracks} tracks over {tracks.num_frames} frames and is_static "
            f"{is_static.shape} do not fit {video.num_frames} frames; give one flag per track of this video"
        )
    observations = observations_of_tracks(tracks, is_static)
    if len(np.unique(observations.track)) < config.geometric_depth.min_pose_points:
        raise DegenerateProblemError(_too_few(video, tracks, observations, config.geometric_depth.min_pose_points))
    structure = structure_from_motion(
        observations, video.num_frames, video.image_size, intrinsics, config, reporter, should_stop, with_doubts,
        camera=camera, any_camera=camera is None or camera.zoom is not None, blur_px=tracks.blur_px, start=start,
    )  # fmt: skip
    if structure is None:
        ideal = camera or CameraModel(intrinsics)
        observations = ideal.ideal_observations(observations)
        is_sought = ideal.is_plain and config.input.intrinsics == "free"
        return _without_parallax(video, tracks, is_static, observations, ideal, config.geometric_depth, is_sought)
    return _with_maps(video, tracks, observations, structure, config, reporter, should_stop)


def _too_few(video: Video, tracks: Tracks, static: Observations, needed: int) -> str:
    """Say why fewer tracks than are needed are static, and what to do."""
    everything = observations_of_tracks(tracks, np.ones(tracks.num_tracks, dtype=bool))
    found, total = (len(np.unique(seen.track)) for seen in (static, everything))
    if total < needed:
        return (
            f"depth from motion: {video.name} has only {counted(total, 'track')} that two frames see, and {needed} are "
            "needed; make more of them (tracking.grid_columns, tracking.grid_rows), or give tracks (--tracks) or depth "
            "maps (--depth)"
        )
    return (
        f"depth from motion: only {found} tracks are static, of {total} in {video.name}, and {needed} are needed: the "
        "others are seen on what masks mark as moving. Check the masks (is 0 what is static, and does anything "
        "stand still?), make more tracks (tracking.grid_columns, tracking.grid_rows), or give depth maps (--depth)"
    )


def _with_maps(
    video: Video,
    tracks: Tracks,
    observations: Observations,
    structure: Structure,
    config: Config,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> GeometricDepth:
    """Scale the structure and make depth maps of it."""
    settings = config.geometric_depth
    stray = observations.table(structure.stray, tracks.visible.shape)
    observations = observations.select(~structure.stray)
    ideal = structure.camera.ideal_observations(observations)
    structure = _normalize(structure, ideal, settings.median_depth)
    inverse = _inverse_depths(structure, ideal, settings)
    # Maps are those of the images.
    observations = replace(ideal, uv=structure.camera.real(ideal.uv, ideal.frame))
    ground, through = _ground(structure, observations, inverse, tracks, video.image_size)
    if through.any():
        structure = replace(structure, moving=structure.moving | through[structure.track])
        inverse[through[observations.track]] = np.nan
    sparse = np.full(tracks.visible.shape, np.nan, dtype=np.float32)
    known = np.isfinite(inverse)
    sparse[observations.track[known], observations.frame[known]] = 1.0 / inverse[known]
    frames = _points_per_frame(structure, observations, inverse, video, tracks.num_tracks, settings)
    maps = InterpolatedDepths(frames, video.image_size, settings, ground=ground)
    depths, said, doubts = _place(maps, video, tracks, structure, reporter, should_stop)
    triangulated = int(np.isfinite(structure.points.position[:, 0]).sum())
    fx, fy = structure.intrinsics[:2]
    facts = (
        f"structure from motion started from frames {structure.pair.first} and {structure.pair.second} "
        f"(parallax {structure.pair.parallax.median:.0f} px); {int(structure.registered.sum())} of {video.num_frames} "
        f"frames posed, {triangulated} of {len(structure.track)} static tracks triangulated, "
        f"noise {structure.sigma_px:.2f} px, fx {fx:.1f} fy {fy:.1f} px",
        *structure.camera.facts(),
        *_reading(structure),
        f"scale by convention: median depth of the first frame is {settings.median_depth:g}",
        f"focal length between {structure.focal.low:.0f} and {structure.focal.high:.0f} px (95 %); the cameras explain "
        f"{100 * (1.0 - structure.unexplained):.0f} % of what was held out",
        *said,
    )
    unusual = unusual_focal(float(np.mean(structure.intrinsics[:2])), video.image_size, settings.usual_focal)
    warnings = (*start_doubts(structure), *unusual, *doubts)
    start = start_summary(structure)
    moving = np.zeros(tracks.num_tracks, dtype=bool)
    moving[structure.track] = structure.moving
    return GeometricDepth(
        depths, structure.world_T_cam, structure.camera, sparse, moving, stray, True, structure.focal_sigma, facts,
        warnings, structure.readout is None, start,
    )  # fmt: skip


def _normalize(structure: Structure, observations: Observations, median_depth: float) -> Structure:
    """Make the first camera the world and bring the median depth that it sees to ``median_depth``."""
    first = structure.world_T_cam[0].copy()
    position = world_to_camera(first, structure.points.position)
    row = np.searchsorted(structure.track, observations.track[observations.frame == 0])
    row = row[row < len(structure.track)]
    seen = position[row[np.isin(structure.track[row], observations.track[observations.frame == 0])], 2]
    seen = seen[seen > 0]
    if len(seen) == 0:
        seen = position[position[:, 2] > 0, 2]
    factor = median_depth / float(np.median(seen))
    poses = np.linalg.inv(first) @ structure.world_T_cam
    poses[:, :3, 3] *= factor
    rotation = first[:3, :3]
    information = rotation.T @ structure.points.information @ rotation / factor**2
    points = replace(structure.points, position=factor * position, information=information)
    return replace(structure, world_T_cam=poses, points=points)


def _inverse_depths(structure: Structure, observations: Observations, config: GeometricDepthConfig) -> FloatArray:
    """Return the inverse depth of every observation's point in its frame, (N,); NaN where poorly known."""
    row = np.searchsorted(structure.track, observations.track)
    known = np.flatnonzero(np.isin(observations.track, structure.track))
    known_in = rows_by_group(observations.frame[known], len(structure.world_T_cam))

    def of_frame(frame: int) -> tuple[IntArray, FloatArray]:
        mine = known[known_in[frame]]
        pose, rows = structure.world_T_cam[frame], row[mine]
        position = structure.points.position[rows]
        x = world_to_camera(pose, position)
        good = np.isfinite(position).all(axis=1) & (x[:, 2] > NEAR_PLANE)
        if structure.registered[frame]:  # elsewhere the pose is too rough to judge a pixel by
            error = np.linalg.norm(project(structure.intrinsics, x) - observations.uv[mine], axis=1)
            good &= error <= config.max_reprojection_px
        mine, rows, z = mine[good], rows[good], x[good, 2]
        if len(mine) == 0:
            return mine, z
        information = structure.points.information[rows]
        sigma = inverse_depth_sigma(pose, position[good], information, max(structure.sigma_px, 0.1))
        inverse = 1.0 / z
        typical = float(np.median(inverse))
        fine = (sigma <= config.max_relative_sigma * typical) & supported(observations.uv[mine], inverse, config)
        return mine[fine], np.maximum(inverse[fine], typical / config.max_depth_ratio)

    out = np.full(len(observations), np.nan)
    for mine, inverse in map_in_order(of_frame, list(range(len(structure.world_T_cam))), thread_count()):
        out[mine] = inverse
    return out


def _ground(
    structure: Structure, observations: Observations, inverse: FloatArray, tracks: Tracks, image_size: tuple[int, int]
) -> tuple[Ground | None, BoolArray]:
    """Find the ground among what is triangulated well, and the tracks (K,) that it shows to move.

    ``inverse`` (N,) is that of every observation's point.
    """
    known = np.isfinite(inverse)
    row = np.searchsorted(structure.track, observations.track[known])
    nearest = np.full(len(structure.track), np.inf)
    np.minimum.at(nearest, row, 1.0 / inverse[known])
    fine = np.isfinite(nearest) & ~structure.moving
    points = structure.points.position[fine]
    plane = find_ground(points, nearest[fine], structure.world_T_cam)
    if plane is None:
        return None, np.zeros(tracks.num_tracks, dtype=bool)
    ground = Ground(plane, structure.world_T_cam, structure.camera)
    on_it = points[plane.holds(points, nearest[fine])]
    through = tracks_through(ground, on_it, structure, observations, tracks, image_size)
    stands = ~through[observations.track]
    if ground.seen_through(observations.select(stands), inverse[stands]):
        return None, np.zeros_like(through)
    return ground, through


def _points_per_frame(
    structure: Structure, observations: Observations, inverse: FloatArray, video: Video, num_tracks: int,
    config: GeometricDepthConfig,
) -> tuple[SparseInverseDepth, ...]:  # fmt: skip
    """Return the points to interpolate in every frame; one without any takes those of the nearest frame."""
    num_frames = len(structure.world_T_cam)
    known = np.flatnonzero(np.isfinite(inverse))
    rows = [known[rows] for rows in rows_by_group(observations.frame[known], num_frames)]
    found = [SparseInverseDepth(observations.uv[mine], inverse[mine]) for mine in rows]
    filled = np.array([len(points.inverse_depth) >= config.min_interpolated_points for points in found])
    if not filled.any():
        everywhere = SparseInverseDepth(np.zeros((1, 2)), np.array([1.0 / config.median_depth]))
        return (everywhere,) * num_frames
    usable = np.flatnonzero(filled)
    points = tuple(found[int(usable[np.argmin(np.abs(usable - frame))])] for frame in range(num_frames))
    often = np.bincount(np.searchsorted(structure.track, observations.track[known]), minlength=len(structure.track))
    sure = (often >= _SEEN_OFTEN) & ~structure.moving
    if video.masks is not None:
        sure &= ~beside_masks(video.masks, observations, num_tracks)[structure.track]
    positions, size = structure.points.position[sure], video.image_size

    def of_frame(frame: int) -> SparseInverseDepth:
        pose = structure.world_T_cam[frame]
        return with_borrowed(points[frame], positions, pose, structure.camera, frame, size, config)

    return tuple(map_in_order(of_frame, list(range(num_frames)), thread_count()))


def _reading(structure: Structure) -> list[str]:
    if structure.readout is None:
        return []
    return [
        f"reading {structure.readout.axis} takes {abs(structure.readout.seconds):.2f} of the time between two frames: "
        "focal length and lens are those of tracks at the time of the middle one"
    ]


def _place(
    depths: InterpolatedDepths, video: Video, tracks: Tracks, structure: Structure, reporter: Reporter,
    should_stop: Callable[[], bool],
) -> tuple[InterpolatedDepths, list[str], list[str]]:  # fmt: skip
    """Put what the masks mark where it stands, or where its motion shows it to be nearer; return facts and warnings."""
    if video.masks is None:
        return depths, [], []
    standing, below, grids = [], [], []
    sightings = Sightings(tracks)
    reporter.begin("depth of moving things", video.num_frames)
    for frame, grid in enumerate(depths.all_grids(reporter, should_stop)):
        mask = video.masks[frame]
        standing.append(ground_contact(mask, enlarged(grid, video.image_size), depths.config))
        below.append(things_below(mask, depths.config.contact_fraction))
        sightings.add(frame, mask)
        grids.append(grid)
    reporter.end()
    depths = replace(depths, grids=tuple(grids))
    feet = feet_of(below, sightings.area)
    sightings.stand_by(feet)
    by_feet = zip(standing, feet, strict=True)
    standing = [{label: here[foot] for label, foot in foot_of.items()} for here, foot_of in by_feet]
    contacts = smooth_over_time(standing, depths.config.contact_smoothing)
    ideal = structure.camera.ideal_tracks(tracks)
    still = ~structure.moving
    cameras = structure.world_T_cam, structure.intrinsics
    noise = CameraNoise.of_points(structure.track[still], structure.points.position[still], ideal, *cameras)
    placed = place_moving(contacts, sightings, ideal, *cameras, noise)
    facts = [
        f"moving thing {label} is {ratio:.1f} times nearer than what is seen below it, as the camera's shake tells"
        for label, ratio in placed.nearer.items()
    ]
    return replace(depths, masks=video.masks, standing=placed.inverse_depth), facts, cut_off(placed.open)


def cut_off(things: list[int]) -> list[str]:
    """Return what to warn of where nothing shows the depth of some moving things, by their labels."""
    if not things:
        return []
    one = len(things) == 1
    named, them, they_are = ("thing", "it", "it is") if one else ("things", "them", "they are")
    return [
        f"the depth of moving {named} {some_of(things, 10)} is a guess: the image cuts {them} off below, and the "
        f"camera's motion does not show how far {they_are}. Give depth maps or a depth network for {them}"
    ]


def _without_parallax(
    video: Video,
    tracks: Tracks,
    is_static: BoolArray,
    observations: Observations,
    camera: CameraModel,
    config: GeometricDepthConfig,
    is_sought: bool,
) -> GeometricDepth:
    """Return depth for a camera that stays in one place: a sphere around it, which a rotation does not change.

    Its focal length is found from the rotations where ``is_sought``.
    """
    height, width = video.image_size
    found = None
    if is_sought:
        found = focal_of_rotations(observations, video.num_frames, video.image_size, camera.intrinsics, config)
    if found is not None:
        camera = camera.with_intrinsics(np.array([found.focal, found.focal, *camera.intrinsics[2:]]))
    intrinsics = camera.intrinsics
    nodes = np.stack(
        np.meshgrid(
            np.append(np.arange(0, width - 1, _SPHERE_STEP), width - 1),
            np.append(np.arange(0, height - 1, _SPHERE_STEP), height - 1),
        ),
        axis=-1,
    )
    uv = nodes.reshape(-1, 2).astype(np.float64)
    sphere = SparseInverseDepth(uv, 1.0 / _on_sphere(uv, intrinsics, config.median_depth))
    depths = InterpolatedDepths((sphere,) * video.num_frames, video.image_size, config)
    sparse = np.full(tracks.visible.shape, np.nan, dtype=np.float32)
    seen = tracks.visible & is_static[:, None]
    sparse[seen] = _on_sphere(tracks.uv[seen].astype(np.float64), intrinsics, config.median_depth)
    poses = rotations_only(observations, video.num_frames, intrinsics)
    turns_px = float(intrinsics[:2].max() * np.linalg.norm(so3_log(poses[:, :3, :3]), axis=1).max())
    turns = turns_px > config.min_parallax_px
    if turns:
        seen_as = f"only rotates (a pure rotation explains the tracks to within {config.min_parallax_px:g} px)"
        real = "rotations are real, structure and moving depth are not"
    else:
        seen_as = f"stands still (tracks stay where they are to within {config.min_parallax_px:g} px)"
        real = "structure and moving depth are not real"
    warnings: tuple[str, ...] = (
        f"the camera {seen_as}, so depth cannot be seen: everything was put at distance {config.median_depth:g}; "
        f"{real}. Give depth maps for those",
    )
    facts: tuple[str, ...] = ("no parallax",)
    if found is not None:
        facts += (f"rotations tell a focal length of {found.focal:.1f} px, to {100 * found.sigma:.0f} %",)
    elif is_sought:
        consequence = ", and rotations err as much as it does" if turns else ""
        warnings += (
            f"the camera turns too little to tell its focal length: {intrinsics[0]:.0f} px is a guess{consequence}; "
            "give K.npy",
        )
    moving = np.zeros(tracks.num_tracks, dtype=bool)
    sigma = 0.0 if found is None else found.sigma
    stray = np.zeros(tracks.visible.shape, dtype=bool)
    return GeometricDepth(depths, poses, camera, sparse, moving, stray, False, sigma, facts, warnings)


def _on_sphere(uv: FloatArray, intrinsics: FloatArray, radius: float) -> FloatArray:
    """Return the z-depth (N,) of a sphere around the camera at pixels (N, 2)."""
    ray = (uv - intrinsics[2:]) / intrinsics[:2]
    result: FloatArray = radius / np.sqrt(1.0 + np.sum(ray**2, axis=1))
    return result
