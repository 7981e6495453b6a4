"""What a saved map says of itself, as plain data and as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from semantic_mapper.config import to_plain
from semantic_mapper.mapping.files.map_file import describe_map
from semantic_mapper.mapping.map_scale import length_unit, voxel_size_text
from semantic_mapper.transport.messages import SCALE_UNKNOWN


def map_summary(path: Path) -> dict[str, Any]:
    """Read a map's manifest, but not its blocks.

    Raises:
        MapError: no such file, not a map, or damaged where it says this.
    """
    manifest = describe_map(path)
    return {
        "map": str(path),
        "format_version": manifest.version,
        "size_bytes": path.stat().st_size,
        "frames": manifest.frames,
        "scale": manifest.scale,
        "last_stamp_ns": manifest.last_stamp_ns,
        "voxel_size_m": manifest.config.voxel_size_m,
        "bounds_m": None if manifest.bounds_m is None else [list(corner) for corner in manifest.bounds_m],
        "blocks": manifest.blocks,
        "measured_voxels": sum(chunk.measured for chunk in manifest.chunks),
        "voted_voxels": sum(chunk.voted for chunk in manifest.chunks),
        "label_set": {
            "name": manifest.label_set.name,
            "ids": list(manifest.label_set.ids),
            "classes": list(manifest.label_set.names),
        },
        "places": 0 if manifest.places is None else manifest.places.places,
        "config": to_plain(manifest.config),
    }


def map_table(found: dict[str, Any]) -> Table:
    """What ``map_summary`` found, for people."""
    table = Table(title=found["map"], title_justify="left", show_header=False)
    table.add_row("format", f"voxel map, version {found['format_version']}")
    table.add_row("size", f"{found['size_bytes'] / 1e6:.1f} MB")
    table.add_row("frames", f"{found['frames']}, the last one at {found['last_stamp_ns'] / 1e9:.3f} s")
    table.add_row("scale", found["scale"])
    known = found["scale"] != SCALE_UNKNOWN
    unit = length_unit(known)
    table.add_row("voxels", voxel_size_text(found["voxel_size_m"], known))
    bounds = found["bounds_m"]
    if bounds is not None:
        low, high = bounds
        table.add_row("extent", " x ".join(f"{b - a:.2f}" for a, b in zip(low, high, strict=True)) + f" {unit}")
        table.add_row("from", ", ".join(f"{x:.2f}" for x in low) + f" {unit}")
        table.add_row("to", ", ".join(f"{x:.2f}" for x in high) + f" {unit}")
    table.add_row("blocks", f"{found['blocks']:,} of 8 x 8 x 8 voxels")
    table.add_row("measured", f"{found['measured_voxels']:,} voxels, {found['voted_voxels']:,} with class votes")
    places = f"{found['places']} views with features" if found["places"] else "none: nothing to find oneself by"
    table.add_row("places", places)
    label_set = found["label_set"]
    table.add_row("classes", f"{label_set['name']}: {', '.join(label_set['classes'])}")
    return table
