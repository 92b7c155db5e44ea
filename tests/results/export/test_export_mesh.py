"""The mesh against the surface of the synthetic scene that it was made from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.synthetic.scene import make_scene
from uni4d_fg.results.export.model import ExportReport
from uni4d_fg.results.fusion.clouds import depth_edges, dilate
from uni4d_fg.results.mesh import Volume
from uni4d_fg.results.run import Run

open3d = pytest.importorskip("open3d")


def distance_to_truth(points: np.ndarray) -> np.ndarray:
    """Distances (N,), m, of points to what stands still in the synthetic room."""
    scene = make_scene()
    still = scene.triangle_instance == 0
    surface = open3d.t.geometry.RaycastingScene()
    surface.add_triangles(
        open3d.core.Tensor(scene.vertices(0.0).astype(np.float32)),
        open3d.core.Tensor(scene.triangles[still].astype(np.uint32)),
    )
    return np.asarray(surface.compute_distance(open3d.core.Tensor(points.astype(np.float32))).numpy())


def test_vertices_lie_on_the_true_surface(source: Run, exported: Callable[..., tuple[Path, ExportReport]]) -> None:
    folder, report = exported("mesh")
    mesh = open3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
    vertices = np.asarray(mesh.vertices)
    assert report.figures["vertices"] == len(vertices) > 1000
    assert len(mesh.triangles) == report.figures["triangles"]
    away = distance_to_truth(vertices)
    voxel = report.figures["voxel_m"]
    # Poses are off by 2 mm and half a millirad, see export_samples.py; voxels are coarser than that.
    assert np.median(away) < 0.25 * voxel
    assert (away > voxel).mean() < 0.01
    assert mesh.has_vertex_colors()
    result = source.reconstruction
    normals = np.asarray(mesh.vertex_normals)
    to_camera = result.world_T_cam[:, :3, 3].mean(axis=0) - vertices
    assert (np.einsum("nk,nk->n", normals, to_camera) > 0).mean() > 0.95


def test_the_mesh_covers_what_frames_see(source: Run, exported: Callable[..., tuple[Path, ExportReport]]) -> None:
    folder, _ = exported("mesh")
    mesh = open3d.t.io.read_triangle_mesh(str(folder / "mesh.ply"))
    caster = open3d.t.geometry.RaycastingScene()
    caster.add_triangles(mesh)
    result = source.reconstruction
    rays = caster.create_rays_pinhole(
        open3d.core.Tensor(camera(result.intrinsics)),
        open3d.core.Tensor(np.linalg.inv(result.world_T_cam[3])), result.image_size[1], result.image_size[0],
    )  # fmt: skip
    met = caster.cast_rays(rays)["t_hit"].numpy()
    still = ~dilate(source.need_sequence().masks[3] > 0, 5)
    still &= ~depth_edges(source.need_depth("a mesh")[3], source.config.fusion.edge_relative_gradient)
    still[:, :8] = still[:, -8:] = still[:8] = still[-8:] = False
    # What fewer than three of seven frames see, and what is far, is left out.
    assert np.isfinite(met[still]).mean() > 0.75


def camera(intrinsics: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def test_the_volume_follows_the_scene() -> None:
    near = ArrayFrames(np.full((3, 20, 20), 2.0, np.float32))
    volume = Volume.of(near, 500.0)
    assert volume.voxel_m == pytest.approx(2 * 2.0 / 500)
    assert Volume.of(ArrayFrames(10 * near.array), 500.0).voxel_m == pytest.approx(10 * volume.voxel_m)
    assert Volume.of(near, 500.0, voxel_m=0.1).voxel_m == 0.1
    far = near.array.copy()
    far[:, :, 10:] = 1000.0
    far[:, :, :9] = 2.0
    assert Volume.of(ArrayFrames(far), 500.0).voxel_m >= 1000.0 / 500 - 1e-9
    with pytest.raises(OutputError, match="no frame has depth"):
        Volume.of(ArrayFrames(np.full((3, 20, 20), np.nan, np.float32)), 500.0)
