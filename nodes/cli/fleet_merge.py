"""``semantic-mapper fleet merge``: maps of one building into tiles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.fleet_run import RayOption, TrustedOption
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted


@verb
def merge(
    maps: Annotated[
        list[str], typer.Argument(metavar="MAPS...", help="Saved maps, folders with one, or URLs of them; two or more.")
    ],
    out: Annotated[str, typer.Option("--out", metavar="STORE", help="Folder or URL for the tiles.")],
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Where maps lie: lines `NAME x y z yaw_deg` (metres; about +z), or JSON with 4 rows of 4 by name. "
            "Places of other maps are found by what they show.",
        ),
    ] = None,
    tile_blocks: Annotated[
        int, typer.Option(min=1, max=1000, help="Edge of a tile in blocks of 8 voxels: 25 are 4 m at 2 cm voxels.")
    ] = 25,
    ray: RayOption = None,
    max_parallel: Annotated[
        int, typer.Option("--max-parallel", min=0, help="Tasks at a time; 0 = what there is room for.")
    ] = 0,
    trusted_network: TrustedOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """Merge maps of one building into tiles, which `query` reads without loading all of them.

    All that the maps have measured adds up, in the world of the first map or of --poses, as `merge` does for two; it
    is refused where a map fits nowhere. Run it again after an interruption: what is done stays done. The name of a map
    is that of its file, or of its folder.

    Example: semantic-mapper fleet merge runs/east runs/west runs/attic --out runs/house
    Example: semantic-mapper fleet merge maps/*.npz --poses poses.txt --out s3://maps/house
    Example: semantic-mapper query runs/house nearest chair 0 0 1
    """
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.nodes.fleet.cluster import connected
    from semantic_mapper.nodes.fleet.merge import check_names, merge_maps, read_poses, run_on_ray
    from semantic_mapper.nodes.fleet.store import Store
    from semantic_mapper.nodes.fleet.urls import is_url
    from semantic_mapper.replay.run_folder import map_path

    if len(maps) < 2:
        raise typer.BadParameter("give two maps or more", param_hint="MAPS")
    for name in maps:
        if not is_url(name):
            map_path(Path(name))
    given = {} if poses is None else read_poses(poses)
    check_names(maps, given)
    store = Store(out, create=True)
    with connected(ray, trusted_network=trusted_network) as cluster:
        report = merge_maps(maps, store, given, run_on_ray(cluster, max_parallel), frame_progress, tile_blocks)
    manifest = report.manifest
    if json:
        places = {source.name: [list(row) for row in source.T_world_map] for source in manifest.sources}
        found = {"store": store.shown, "maps": places, "tiles": len(manifest.tiles), "blocks": manifest.blocks}
        output.json({**found, "frames": manifest.frames, "peak_bytes": report.peak_bytes})
        return
    for note in report.notes:
        output.print(note)
    content = f"{counted(manifest.frames, 'frame')}, {counted(manifest.blocks, 'block')}"
    output.print(f"{store.shown}: {counted(len(manifest.tiles), 'tile')}; {content}")
    if report.peak_bytes:
        output.print(f"  at most {report.peak_bytes / 1e6:.0f} MB in a worker")
