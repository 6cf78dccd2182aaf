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


def test_an_empty_section_changes_nothing(tmp_path):
    assert load_config(written(tmp_path, "rotation:\ngeodesics:\n")) == Config()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("geodesics: {nodes: many}", "geodesics.nodes|GeodesicConfig.nodes"),
        ("geodesics: {node: 3}", "did you mean 'geodesics.nodes'"),
        ("- a\n- b", "expected settings"),
        ("a: [", "cannot be read as YAML"),
        ("method: magic", "method"),
        ("rotation: {ros__parameters: 5}", "expected settings, name: value; got 5"),
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


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        ("typical: 0.36", "typical: .inf", "sizes.waist_width"),
        ("spread: 0.35", "spread: .nan", "sizes.waist_width"),
        ("swing: 30", "swing: .nan", "swing: expected a number"),
        ("swing: 30", "swing: -3", "swing: expected a number of 0 or more"),
        ("spread: 3\n", "spread: -3\n", "spread: expected"),
        ("angle: 2", "angle: .inf", "angle: expected"),
        ("[crotch, waist_front]", "[crotch, crotch]", "measurements.rise: its path has no length"),
        ("name: hip, at", "name: hip, prt: leg, at", "unknown key 'prt' of a point"),
    ],
)
def test_a_category_that_cannot_be_is_refused_as_it_is_read(tmp_path, was, becomes, says):
    from vflatten_ros.categories import load_templates
    from vflatten_ros.resources import config_path

    text = (config_path("categories") / "trousers.yaml").read_text()
    assert was in text
    (tmp_path / "trousers.yaml").write_text(text.replace(was, becomes, 1))
    with pytest.raises(InvalidConfig, match=says) as caught:
        load_templates(tmp_path)
    assert "trousers" in str(caught.value)
