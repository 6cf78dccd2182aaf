"""Settings files."""

import pytest

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import InvalidConfig
from vflatten_ros.files import load_config


def written(tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "/**:\n  ros__parameters:\n    geodesics: {nodes: 44}\n",
        "vflatten:\n  ros__parameters:\n    geodesics.nodes: 44\n    autostart: false\n",
        "/rig_a:\n  vflatten:\n    ros__parameters:\n      geodesics: {nodes: 44}\n",
        "geodesics:\n  nodes: 44\n",
        "geodesics.nodes: 44\nuse_sim_time: true\n",
    ],
)
def test_settings_are_read_from_ros_parameters_and_from_plain_ones(tmp_path, text):
    config = load_config(written(tmp_path, text))
    assert config.geodesics.nodes == 44
    assert config.flattening == Config().flattening


def test_an_empty_file_changes_nothing(tmp_path):
    assert load_config(written(tmp_path, "")) == Config()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("geodesics: {nodes: many}", "geodesics.nodes|GeodesicConfig.nodes"),
        ("geodesics: {node: 3}", "did you mean 'geodesics.nodes'"),
        ("- a\n- b", "expected settings"),
        ("a: [", "cannot be read as YAML"),
        ("method: magic", "method"),
    ],
)
def test_wrong_settings_name_the_file_and_the_trouble(tmp_path, text, says):
    with pytest.raises(InvalidConfig, match=says) as caught:
        load_config(written(tmp_path, text))
    assert "settings.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(InvalidConfig, match="no such file; check --config"):
        load_config(tmp_path / "none.yaml")


def test_the_settings_that_come_with_the_package_are_read():
    from vflatten_ros.resources import config_path

    assert load_config(config_path("vflatten.yaml")).method in ("rotation", "kita2019")
