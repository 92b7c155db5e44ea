"""What to distrust in solved cameras and landmarks; the same for batch, windows and streams."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, IntArray
from uni4d_fg.counted import counted
from uni4d_fg.frontend.sequence.calibration import given_doubts, unusual_focal
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.pipeline.path_uncertainty import path_uncertainty
from uni4d_fg.robust import WITHIN_95

_MAX_FOCAL_CHANGE = 0.15
_MIN_BASELINE = 0.01
"""Of the scene's depth."""
_MAX_FOCAL_SIGMA = 0.04
"""Standard deviation, as a part of the focal length, above which it counts as poorly determined."""
_MAX_UNCERTAINTY = 0.05
"""Root mean square of the positions' sigmas, of the path's length: a path that may be off by a twentieth of itself."""
_DEPTH_IS_FROM = {
    None: ": depth comes from the cue alone",
    True: ", from which all depth was found",
    False: ", which was assumed",
}

KEEP_GIVEN = "set input.intrinsics=fixed if those that were given are right"
"""What to do about focal lengths that are doubtful where some were given."""

_MOVES_SIGMAS, _MOVES_PART = 3.0, 0.01
"""Median reprojection error of a track that does not fit a static world: as a multiple of the noise, and at least, as a
part of the longer image side; what lies below may be a tracker's or a lens's, alike in neighboring tracks too."""
_MOVING_SHARE = 0.03
"""Share of such tracks from which something seems to move."""
_BY_CHANCE = 1e-3
"""Probability that as many of them lie side by side by chance, below which they are one thing and no stray tracks."""


def unmasked_motion_warnings(
    labelled: LabelledTracks,
    landmark_track: IntArray,
    landmark_error: Float32Array,
    noise_px: float,
    longer_side_px: int,
    dropped: Callable[[], tuple[IntArray, FloatArray]],
) -> list[str]:
    """Return a sentence if something seems to move and no track was labelled as moving.

    Tracks of a moving thing that is taken for static fit no camera; unlike stray tracks they lie side by side.

    Args:
        labelled: All tracks.
        landmark_track: (N,) tracks of the static scene's landmarks.
        landmark_error: (N,) their median reprojection errors, px.
        noise_px: Standard deviation of the static scene's reprojection.
        longer_side_px: Of the images.
        dropped: Returns static tracks (D,) that are no landmarks, and their errors (D,), px, NaN where not known.
    """
    if len(landmark_track) < 2 or (labelled.label == TrackLabel.DYNAMIC).any():
        return []
    others, error = dropped()
    track, error = np.concatenate([landmark_track, others]), np.concatenate([landmark_error, error])
    with np.errstate(invalid="ignore"):
        moves = error > max(_MOVES_SIGMAS * noise_px, _MOVES_PART * longer_side_px)
    share = float(moves.mean())
    if share < _MOVING_SHARE:
        return []
    from scipy.spatial import cKDTree
    from scipy.stats import binom

    seen = labelled.weight[track, :, None] > 0
    place = np.where(seen, labelled.tracks.uv[track], 0.0).sum(axis=1) / seen.sum(axis=1)
    _, nearest = cKDTree(place).query(place[moves], k=2)
    beside = int(moves[nearest[:, 1]].sum())
    if binom.sf(beside - 1, int(moves.sum()), share) > _BY_CHANCE:
        return []
    return [
        f"{100 * share:.0f} % of the static tracks lie together and fit no static world: something seems to move, and "
        "no mask covers it; give masks, or have them made from motion (--masks motion)"
    ]


def blur_warnings(blur_px: Float32Array | None, patch_px: int) -> list[str]:
    """Return a sentence if motion blur (T,), px, is longer than the patches of the tracker anywhere.

    What is smeared over more than a patch has no place in it along the blur: tracks slide there by pixels.
    """
    if blur_px is None or not (blur_px > patch_px).any():
        return []
    blurred = np.flatnonzero(blur_px > patch_px)
    frames = f"{counted(len(blurred), 'frame')} by {patch_px} px and more ({some_of(blurred.tolist())})"
    return [
        f"the camera's motion blurs {frames}: "
        "tracks slide there by pixels, and the path, focal lengths and a lens or zoom that was found may be far off; "
        "give what of them is known (--intrinsics, camera.model), or leave these frames out (--start, --stop)"
    ]


def started_from_a_guess(guessed_intrinsics: FloatArray) -> str:
    """Return what a summary says of a solve that started from guessed intrinsics (4,), px."""
    return f"no intrinsics were given: the focal length started from a guess, {guessed_intrinsics[0]:.0f} px"


def intrinsics_warnings(video: Video | Sequence) -> list[str]:
    """Return a sentence if given intrinsics are odd; those that camera motion told are doubted where it does."""
    given = video.intrinsics if isinstance(video, Video) else video.given_intrinsics
    if given is None or video.is_self_calibrated:
        return []
    return given_doubts(given, video.image_size)


def focal_warnings(given_intrinsics: FloatArray | None, focal_px: FloatArray) -> list[str]:
    """Return a sentence if focal lengths are far from the given intrinsics (4,), px, if any were given.

    Args:
        given_intrinsics: None where they were guessed.
        focal_px: (2,) px, or (F, 2) of a camera that zooms, of which the given ones may be those of any frame.
    """
    if given_intrinsics is None:
        return []
    focal_px = np.atleast_2d(focal_px)
    change = float(np.abs(focal_px / given_intrinsics[:2] - 1.0).max(axis=1).min())
    if change <= _MAX_FOCAL_CHANGE:
        return []
    shortest, longest = (f"{focal:.0f}" for focal in (focal_px.mean(axis=1).min(), focal_px.mean(axis=1).max()))
    found = shortest if shortest == longest else f"{shortest} to {longest}"
    return [
        f"the focal lengths moved by {100 * change:.0f} % from the given ones: {found} px was found, and "
        f"{given_intrinsics[:2].mean():.0f} px given"
    ]


def found_focal_warnings(sequence: Sequence, focal_px: FloatArray, usual: tuple[float, float]) -> list[str]:
    """Return what is odd about the focal lengths that a run ends with.

    Those that camera motion told before the run are doubted where it does, and those that were given and stayed there
    by :func:`intrinsics_warnings`.

    Args:
        sequence: As it came in.
        focal_px: (2,) px, or (F, 2) of a camera that zooms.
        usual: Range of focal lengths that cameras have, as parts of the longer image side.
    """
    moved = focal_warnings(sequence.given_intrinsics, focal_px)
    if sequence.is_self_calibrated:
        return moved
    if sequence.intrinsics_are_guessed:
        return unusual_focal(float(focal_px.mean()), sequence.image_size, usual)
    return moved + (unusual_focal(float(focal_px.mean()), sequence.image_size, usual, KEEP_GIVEN) if moved else [])


def scene_warnings(
    intrinsics: FloatArray,
    world_T_cam: FloatArray,
    landmarks: FloatArray,
    pose_covariance: FloatArray | None = None,
    intrinsics_covariance: FloatArray | None = None,
    *,
    focal_was_doubted: bool = False,
    depth_parallax: bool | None = None,
) -> list[str]:
    """Return one sentence for everything that makes a static scene doubtful.

    Args:
        intrinsics: (4,) fx, fy, cx, cy, px, that the solve ended with.
        world_T_cam: (T, 4, 4) poses.
        landmarks: (N, 3) world, meters.
        pose_covariance: (T, 6, 6) of the poses' twists, translation last; NaN where it is not known.
        intrinsics_covariance: (4, 4) of ``intrinsics``, px^2; zero where they were held, NaN where it is not known.
        focal_was_doubted: How well the focal lengths are known was said where they were found.
        depth_parallax: Whether the depth that was made from motion saw any; None for depth that was given.
    """
    warnings = list[str]()
    if not len(landmarks):
        return [*warnings, "there are no landmarks: the cameras rest on nothing that was measured"]
    first = world_T_cam[0, :3, 3]
    baseline = float(np.linalg.norm(world_T_cam[:, :3, 3] - first, axis=1).max())
    depth = float(np.median(np.linalg.norm(landmarks - first, axis=1)))
    focal_sigma = _focal_sigma(intrinsics_covariance, intrinsics)
    if baseline < _MIN_BASELINE * depth:
        text = f"the camera moves by only {100 * baseline / depth:.2f} % of the scene's depth"
        text += _DEPTH_IS_FROM[depth_parallax]
        # A camera that turns on the spot determines its focal length; one that is held needs no determining.
        if not focal_sigma <= _MAX_FOCAL_SIGMA:
            text += ", and the focal length is poorly determined"
        return [*warnings, text]
    uncertainty = path_uncertainty(world_T_cam, pose_covariance)
    if uncertainty > _MAX_UNCERTAINTY:  # false where it is not known
        warnings.append(
            f"camera positions are uncertain by {100 * uncertainty:.0f} % of the path's length: too little that is "
            "static is seen well; look at masks, tracks and the share of the image that moves"
        )
    return warnings if focal_was_doubted else warnings + _open_focal(intrinsics, focal_sigma)


def _open_focal(intrinsics: FloatArray, sigma: float) -> list[str]:
    """Return a sentence if focal lengths that were solved for are known badly; none where it is not known how well."""
    if not sigma > _MAX_FOCAL_SIGMA:
        return []
    return [
        f"this video leaves the focal length open: {intrinsics[:2].mean():.0f} px was found, give or take "
        f"{100 * WITHIN_95 * sigma:.0f} % (95 %); depth, and motion along the viewing direction, stretch with it; "
        "set input.intrinsics=fixed if the given one is known"
    ]


def _focal_sigma(covariance: FloatArray | None, intrinsics: FloatArray) -> float:
    """Return the standard deviation of the focal lengths, as a part of them, from a covariance (4, 4), px^2, or NaN."""
    return np.nan if covariance is None else float((np.sqrt(np.diagonal(covariance)[:2]) / intrinsics[:2]).max())
