"""A real map, exported and read back: options reach the file, and those that mean nothing are refused."""

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import rerun.chunk

from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.geometry import look_at
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.graph import find_graph
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.replay.exporters.map_files import AXES, ExportRequest, export_map, format_of, parse_up, read_costs
from semantic_mapper.replay.rerun_layout import COMPUTED_COLOR, MEASURED_COLOR
from semantic_mapper.replay.rerun_log import RerunLog, recording_file
from tests.mapping.rendered_views import frame, plane_depth, small_map, sure
from tests.mapping.test_formats import read_glb
from tests.queries.test_measured import part_measured

LABELS = make_label_set("corner", ("table", "floor", "wall"), ids=(5, 9, 2))


@pytest.fixture(scope="module")
def corner() -> VoxelMap:
    """A floor (z = 0) seen twice, and a wall (y = 2), seen once."""
    voxel_map = small_map(LABELS)
    up = np.array((0.0, 0.0, 1.0))
    for seq, (target, normal, offset, channel, p) in enumerate(
        (
            ((0.2, 1.3, 0.0), (0, 0, 1), 0.0, 1, 0.9),
            ((0.3, 1.2, 0.0), (0, 0, 1), 0.0, 1, 0.9),
            ((0.4, 2.0, 0.6), (0, 1, 0), 2.0, 2, 0.6),
        )
    ):
        pose = look_at(np.array((0.1, 0.4, 1.2)), np.array(target), up)
        voxel_map.integrate(frame(pose, seq=seq), plane_depth(pose, normal, offset), sure(channel, p), None)
    return voxel_map


def test_formats_and_directions_are_read_from_words() -> None:
    assert format_of(Path("a.GLB"), None) == "glb" and format_of(Path("a.yaml"), None) == "grid"
    assert format_of(Path("a.ply"), None) == "ply" and format_of(Path("a.ply"), "ply-mesh") == "ply-mesh"
    for path, given in ((Path("a.stl"), None), (Path("map"), None), (Path("a.ply"), "stl")):
        with pytest.raises(ConfigError, match="names no format"):
            format_of(path, given)
    assert parse_up("auto") is None and len(AXES) == 6
    np.testing.assert_array_equal(parse_up("-y"), (0, -1, 0))
    np.testing.assert_allclose(parse_up("0, 3 -4"), (0, 0.6, -0.8))
    for text in ("up", "1 2", "0 0 0", "nan 0 1"):
        with pytest.raises(ConfigError, match="--up"):
            parse_up(text)


def test_options_that_a_format_cannot_honour_are_refused(corner: VoxelMap, tmp_path: Path) -> None:
    for request, message in (
        (ExportRequest("rrd", color="class"), "--color means nothing for format rrd; it is for ply, ply-mesh, glb"),
        (ExportRequest("ply-mesh", up=AXES["z"]), "--up means nothing for format ply-mesh"),
        (ExportRequest("glb", height=(0.1, 1)), "--height"),
    ):
        with pytest.raises(ConfigError, match=message):
            export_map(corner, tmp_path / "out", request)
    with pytest.raises(MapError, match="smaller than voxels"):
        export_map(corner, tmp_path / "out", ExportRequest("grid", resolution=0.01))
    with pytest.raises(MapError, match="no surface"):
        export_map(corner, tmp_path / "out.glb", ExportRequest("glb", min_weight=4))
    assert not list(tmp_path.iterdir())


def test_a_mesh_keeps_its_place_and_faces_through_glb(corner: VoxelMap, tmp_path: Path) -> None:
    report = export_map(corner, tmp_path / "map.glb", ExportRequest("glb", color="class"))
    mesh = corner.mesh()
    assert report.files == (tmp_path / "map.glb",) and f"{len(mesh.faces):,} faces" in report.content
    assert report.found == ("up is z (--up sets it)",)
    read = read_glb(tmp_path / "map.glb")
    np.testing.assert_array_equal(read["POSITION"], mesh.vertices)
    np.testing.assert_array_equal(read["indices"].reshape(-1, 3), mesh.faces)
    assert set(np.unique(mesh.label)) >= {9, 2}
    wall, floor = read["POSITION"][mesh.label == 2], read["POSITION"][mesh.label == 9]
    assert abs(np.median(wall[:, 1]) - 2) < 0.01 and abs(np.median(floor[:, 2])) < 0.01


def test_weight_and_confidence_leave_out_what_is_less_sure(corner: VoxelMap, tmp_path: Path) -> None:
    def labels(**changes: float) -> np.ndarray:
        export_map(corner, tmp_path / "points.ply", dataclasses.replace(ExportRequest("ply"), **changes))
        cloud = load_open3d().t.io.read_point_cloud(str(tmp_path / "points.ply"))
        return np.unique(cloud.point["label"].numpy(), return_counts=True)

    everything = corner.points()
    ids, counts = labels()
    assert counts.sum() == len(everything.xyz)
    ids, counts = labels(min_confidence=0.7)
    assert ids.tolist() == [9] and counts.sum() == (everything.confidence >= 0.7).sum() > 100
    ids, counts = labels(min_weight=2)
    assert (counts[ids == 2].sum() < 50) and counts[ids == 9] > 1000


def test_a_plan_says_what_was_found_and_costs_are_read_by_class(corner: VoxelMap, tmp_path: Path) -> None:
    (tmp_path / "costs.toml").write_text("floor = 10\nwall = 90\nunknown = 50\n")
    request = ExportRequest("grid", height=(0.2, 1.0), costs=tmp_path / "costs.toml")
    report = export_map(corner, tmp_path / "plan.yaml", request)
    assert report.found[0] == "up is z (--up sets it)" and "floor at 0.00 m" in report.found[1]
    assert "cells of 0.05 m" in report.content and "m2 free" in report.content
    assert not export_map(corner, tmp_path / "plan.yaml", ExportRequest("grid", up=AXES["z"], floor=0.0)).found
    report = export_map(corner, tmp_path / "plan.yaml", request)
    assert [path.name for path in report.files] == ["plan.yaml", "plan.pgm", "plan_costs.yaml", "plan_costs.pgm"]
    plan, costs = (np.frombuffer(path.read_bytes().split(b"\n", 3)[3], np.uint8) for path in report.files[1::2])
    assert set(costs) == {10, 50, 90, 255} and ((costs == 255) == (plan == 205)).all()
    assert (costs[plan == 0] == 90).mean() > 0.8 and (costs[plan == 254] == 10).mean() > 0.8
    for text, message in (
        ("flor = 1", "flor = 1: a cost is a whole number .* of one of the classes floor, table"),
        ("floor = 101", "a cost is a whole number from 0"),
        ("floor = true", "a cost is a whole number from 0"),
        ("floor", "costs.toml"),
        ("# floor = 1", "costs.toml: has no costs"),
    ):
        (tmp_path / "costs.toml").write_text(text)
        with pytest.raises(ConfigError, match=message):
            export_map(corner, tmp_path / "plan.yaml", request)


def test_the_costs_that_the_howto_shows_are_those_of_a_map_of_rooms(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "robots.md").read_text(encoding="utf-8")
    shown = text.split("`costs.toml` has lines")[1].split("```toml\n")[1].split("```")[0]
    (tmp_path / "costs.toml").write_text(shown)
    costs = read_costs(tmp_path / "costs.toml", ROOMS)
    assert costs[ROOMS.ids[ROOMS.names.index("chair")]] == 80 and (costs >= 0).sum() == 3


def test_files_of_a_map_without_metres_say_so_and_a_plan_is_refused(corner: VoxelMap, tmp_path: Path) -> None:
    corner.save(tmp_path / "map.npz")
    unknown = VoxelMap.load(tmp_path / "map.npz")
    unknown.note_scale(False)
    for name, where in (("a.ply", "comment scale: unknown"), ("a.glb", '"scale":"unknown"')):
        report = export_map(unknown, tmp_path / name, ExportRequest(format_of(tmp_path / name, None)))
        assert report.found[-1] == "scale: unknown; lengths are not metres"
        assert where.encode() in (tmp_path / name).read_bytes()
        report = export_map(corner, tmp_path / name, ExportRequest(format_of(tmp_path / name, None)))
        assert where.encode() not in (tmp_path / name).read_bytes()
        assert not any("scale" in line for line in report.found)
    export_map(unknown, tmp_path / "a.rrd", ExportRequest("rrd"))
    assert "/scale" in {chunk.entity_path for chunk in rerun.chunk.RrdReader(tmp_path / "a.rrd").stream()}
    with pytest.raises(MapError, match=r"floor plan: needs metres.*mapper scale"):
        export_map(unknown, tmp_path / "plan.yaml", ExportRequest("grid"))
    assert not (tmp_path / "plan.pgm").exists()


def test_rerun_shows_what_was_measured_and_where_things_were_that_have_gone(corner: VoxelMap, tmp_path: Path) -> None:
    voxel_map = part_measured()
    measured = voxel_map.points().measured
    assert measured is not None
    box = OrientedBox(np.array((1.0, 2.0, 3.0)), np.ones(3), np.eye(3))
    thing = Instance(7, 5, "table", 0.9, box.center, box, np.zeros((1, 3), np.int32), gone_ns=2_500_000_000)
    log = RerunLog(recording_file(tmp_path / "a.rrd"), corner.label_set, corner.config.voxel_size_m)
    log.log_graph(find_graph(corner), [thing])
    log.finish(voxel_map.points())
    chunks = {chunk.entity_path: chunk for chunk in rerun.chunk.RrdReader(tmp_path / "a.rrd").stream()}
    parts = [chunks[f"/world/map/measured{part}"].to_record_batch() for part in ("", "/ceiling")]
    colors = Counter(color >> 8 for part in parts for color in part.column("Points3D:colors").to_pylist()[0])
    shown = {int.from_bytes(bytes(c), "big"): n for c, n in ((MEASURED_COLOR, measured), (COMPUTED_COLOR, ~measured))}
    assert colors == {color: of.sum() for color, of in shown.items()}
    found = chunks["/world/graph/gone"].to_record_batch()
    assert found.column("Boxes3D:labels").to_pylist() == [["table 7, gone at 2.5 s"]]
    np.testing.assert_allclose(found.column("Boxes3D:centers").to_pylist()[0], [(1, 2, 3)])
