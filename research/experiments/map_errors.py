"""Maps beside a mesh, from above: classes, and each point of the surface in the colour of its distance from the mesh.

Example: python -m research.experiments.map_errors runs/sensor runs/computed --mesh mesh_labels.npz --out errors.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from semantic_mapper.mapping.fusion.depth_trust import SURFACE_WEIGHT
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import new_figure, put_title, rendered, write_picture
from semantic_mapper.types import Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FARTHEST_M = 0.20  # has the last colour
WIDTH, HEIGHT = 460, 310  # of a panel, pixels


class Cloud(NamedTuple):
    """Points of a surface (N, 3) and how far each is from the other surface (N,), both in metres; and the colours of
    their classes (N, 3) uint8, of a map."""

    name: str
    xyz: Float64
    off_m: Float64
    rgb: UInt8 | None = None


def compare(run: Path, vertices: Float64, min_weight: float) -> tuple[Cloud, Cloud]:
    """Points of a run's map with their distances from the mesh, and vertices of the mesh with theirs from the map."""
    voxel_map = VoxelMap.load(run / "map.npz")
    points = voxel_map.points(min_weight)
    xyz = points.xyz.astype(np.float64)
    return (
        Cloud(run.name, xyz, cKDTree(vertices).query(xyz)[0], voxel_map.label_set.colorize(points.label)),
        Cloud(run.name, vertices, cKDTree(xyz).query(vertices)[0]),
    )


@rendered
def draw(pairs: Sequence[tuple[Cloud, Cloud]], to_gravity: Float64) -> Figure:
    """First row: classes of the maps. Then distances: of the points of the maps, and of the vertices of the mesh."""
    width, height = WIDTH * len(pairs) + 110, 3 * HEIGHT + 70
    figure = new_figure(width, height)
    put_title(
        figure, "Maps from above", "classes; distance of their points from the mesh; distance of the mesh from them"
    )
    level = [cloud.xyz @ to_gravity[:3, :3].T for pair in pairs for cloud in pair]
    low, high = np.quantile(np.concatenate(level), (0.002, 0.998), axis=0)
    dots = None
    for column, pair in enumerate(pairs):
        for row, cloud in enumerate((pair[0], *pair)):
            box = (
                (column * WIDTH + 12) / width,
                (2 - row) * HEIGHT / height,
                (WIDTH - 24) / width,
                (HEIGHT - 30) / height,
            )
            axes = figure.add_axes(box, aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.set_axis_off()
            xyz = cloud.xyz @ to_gravity[:3, :3].T
            order = np.argsort(xyz[:, 2])
            if row == 0:
                assert cloud.rgb is not None
                axes.scatter(*xyz[order, :2].T, c=cloud.rgb[order] / 255, s=0.4)
                axes.set_title(cloud.name, fontsize=9)
                continue
            dots = axes.scatter(
                *xyz[order, :2].T, c=cloud.off_m[order] * 100, s=0.4, cmap="turbo", vmin=0, vmax=FARTHEST_M * 100
            )
            within = (
                f"within 5 cm {(cloud.off_m < 0.05).mean() * 100:.0f} %, 10 cm {(cloud.off_m < 0.1).mean() * 100:.0f} %"
            )
            axes.set_title(f"{cloud.name}: {within}", fontsize=9)
    if dots is not None:
        bar = figure.colorbar(dots, cax=figure.add_axes(((width - 90) / width, 0.2, 16 / width, 0.5)))
        bar.set_label("cm")
    return figure


def main() -> None:
    """Draw it, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="folders that replay wrote")
    parser.add_argument("--mesh", type=Path, required=True, help="NPZ with vertices (V, 3) and T_gravity (4, 4)")
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    parser.add_argument("--min-weight", type=float, default=SURFACE_WEIGHT, help="of a voxel of the surface")
    given = parser.parse_args()
    with np.load(given.mesh) as mesh:
        vertices, to_gravity = np.asarray(mesh["vertices"], np.float64), np.asarray(mesh["T_gravity"], np.float64)
    pairs = [compare(run, vertices, given.min_weight) for run in given.runs]
    for on_map, on_mesh in pairs:
        within = ", ".join(f"{(on_mesh.off_m < m).mean() * 100:.1f} % within {m * 100:.0f} cm" for m in (0.05, 0.10))
        print(f"{on_map.name}: {np.median(on_map.off_m) * 1e3:.1f} mm (median) from the mesh; of the mesh {within}")
    write_picture(given.out, draw(pairs, to_gravity))


if __name__ == "__main__":
    main()
