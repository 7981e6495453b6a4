from pathlib import Path
from typing import Any

import pytest

from semantic_mapper.config import (
    MAX_FILE_BYTES,
    MapperConfig,
    Quality,
    VoxelMapConfig,
    convert_config,
    load_config,
    load_mapper_config,
    read_json,
)
from semantic_mapper.errors import ConfigError


def write(folder: Path, text: str) -> Path:
    path = folder / "mapper.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, "seed = 3\n[voxel_map]\nvoxel_size_m = 0.05\n"), MapperConfig)
    assert config.seed == 3
    assert config.voxel_map == VoxelMapConfig(voxel_size_m=0.05)
    assert config.sampling == MapperConfig().sampling


@pytest.mark.parametrize(
    ("text", "nearest"),
    [
        ("sede = 1", "seed"),
        ("[voxelmap]", "voxel_map"),
        ("[voxel_map]\nvoxel_size = 0.05", "voxel_size_m"),
        ("[keyframes]\nsource_view = 4", "source_views"),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_valid_one(tmp_path: Path, text: str, nearest: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path, MapperConfig)
    assert str(path) in str(caught.value)
    assert f"did you mean `{nearest}`?" in str(caught.value)


@pytest.mark.parametrize(
    ("quality", "text", "clash"),
    [
        ("fast", "[sampling]\nguided = 4", r"sampling\.guided = 4 \(fast: 2\)"),
        (
            "fast",
            "[sampling]\nfree_space = 0\n[render]\nray_fraction = 0.5",
            r"otherwise: render\.ray_fraction = 0\.5 \(fast: 0\.12\);",
        ),
        ("reference", "[render]\ntarget_hz = 5", r"render\.target_hz = 5 \(reference: 0\.0\)"),
        ("balanced", "[sampling]\nguided = 4\n[render]\nscale = 0.5", None),
        ("custom", "[sampling]\nguided = 4\n[render]\nray_fraction = 0.5", None),
    ],
)
def test_what_a_quality_would_override_is_refused(
    tmp_path: Path, quality: Quality, text: str, clash: str | None
) -> None:
    """Whether the file asks for the quality itself or the command line does."""
    plain, own = write(tmp_path, text), tmp_path / "own.toml"
    own.write_text(f'quality = "{quality}"\n{text}', encoding="utf-8")
    for path, asked in ((plain, quality), (own, None)):
        if clash is None:
            assert load_mapper_config(path, {"quality": asked}).quality == quality
        else:
            with pytest.raises(ConfigError, match=rf"{path.name}: .*{clash}"):
                load_mapper_config(path, {"quality": asked})
    assert load_mapper_config(own, {"quality": "custom"}).quality == "custom"


@pytest.mark.parametrize(
    ("section", "what"),
    [
        ({"seed": "one"}, "seed"),
        ({"sampling": {"mode": "fast"}}, "sampling.mode"),
        ({"voxel_map": {"voxel_size_m": "2cm"}}, "voxel_map.voxel_size_m"),
        ({"voxel_map": 3}, "voxel_map"),
        ({"sampling": {"guided": 1}}, "guided"),
        ({"sampling": {"near_m": 2.0, "far_m": 1.0}}, "far_m must lie beyond near_m"),
        ({"sampling": {"guided": 4, "free_space": 3}}, "free_space must leave"),
        ({"keyframes": {"source_views": 17}}, "source_views"),
        ({"keyframes": {"capacity": 0}}, "capacity"),
        ({"render": {"rays_per_chunk": -1}}, "rays_per_chunk"),
        ({"voxel_map": {"voxel_size_m": -0.02}}, "voxel_size_m"),
        ({"sampling": {"far_m": 1e9}}, "far_m"),
        ({"render": {"encode_width": 10**6}}, "encode_width"),
    ],
)
def test_values_that_make_no_sense_are_refused_by_name(section: dict[str, Any], what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        convert_config(section, MapperConfig, "settings.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("seed = " + "9" * 5000, "not valid TOML"),
        ("x = " + "[" * 20000, "not valid TOML"),
        ("seed = " + "9" * 4000, r"seed = a number of 13288 bits"),
        ("seed = 9223372036854775808", "seed = a number of 64 bits"),
        ("[voxel_map]\nvoxel_size_m = inf", "voxel_map.voxel_size_m = inf: give a number between"),
        ("[voxel_map]\nvoxel_size_m = nan", "voxel_map.voxel_size_m = nan"),
        ("[voxel_map]\ndepth_max_m = 1e308", r"voxel_map.depth_max_m = 1e\+308"),
        ("[voxel_map]\nvoxel_size_m = 1e-300", "voxel_size_m"),
        ('[render]\ndevice = "a\\u0000b"', "render.device holds a NUL character"),
        ("k" * 100_000 + " = 1", "unknown key"),
        ("#" * (MAX_FILE_BYTES + 1), "larger than the limit of 1,048,576 bytes"),
    ],
)
def test_a_hostile_file_is_refused_by_name_in_few_words(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "mapper.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=says) as caught:
        load_config(path, MapperConfig)
    assert str(path) in str(caught.value) and len(str(caught.value)) < 1500


@pytest.mark.parametrize(
    "text", ['{"a": ' + "[" * 100_000, '{"a": NaN}', '{"a": 1e999}', '{"a": ' + "9" * 5000 + "}", "[]", "\x80"]
)
def test_hostile_json_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError, match=r"camera\.json: "):
        read_json(path, dict)
