"""The package as a whole: what it imports, its version, its settings and its files."""

from __future__ import annotations

import ast
import dataclasses
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from vflatten_ros import resources
from vflatten_ros.core.config import Config, config_from, flatten_config, sections
from vflatten_ros.core.errors import InvalidConfig

ROOT = Path(__file__).resolve().parent.parent
CORE_MODULES = sorted(
    f"vflatten_ros.core.{path.stem}" for path in (ROOT / "vflatten_ros" / "core").glob("[a-z]*.py")
)

# Where the rosdep key is not the name of the import. None: PyPI only (docs/dependencies.md).
ROSDEP_KEYS = {
    "cv2": "python3-opencv",
    "matplotlib": "python3-matplotlib",
    "mcap": None,
    "mcap_ros2": None,
    "mpl_toolkits": "python3-matplotlib",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "tf2_ros": "tf2_ros_py",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}


def package_xml() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_core_imports_no_ros_no_files_and_no_plots():
    unwanted = {"rclpy", "mcap", "yaml", "matplotlib", "tqdm", "vflatten_ros.msg"}
    loaded = run_python(f"import sys, {', '.join(CORE_MODULES)}; print(*sys.modules)").split()
    assert CORE_MODULES[0] in loaded
    assert unwanted.isdisjoint(loaded)


def imports_of(path: Path) -> set[str]:
    """Top-level names that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def test_package_xml_declares_every_import():
    files = [*(ROOT / "vflatten_ros").rglob("*.py"), *(ROOT / "launch").glob("*.py")]
    imported = set().union(*map(imports_of, files)) - sys.stdlib_module_names - {"vflatten_ros"}
    keys = {ROSDEP_KEYS.get(name, name) for name in imported} - {None}
    declared = {item.text for item in package_xml() if item.tag in ("depend", "exec_depend")}
    assert keys <= declared, f"missing in package.xml: {sorted(keys - declared)}"


def test_versions_of_ros_and_pip_packages_agree():
    version = package_xml().findtext("version")
    printed = subprocess.check_output(
        [sys.executable, "setup.py", "--version"], cwd=ROOT, text=True
    )
    assert printed.split()[-1] == version


def test_every_default_survives_being_written_and_read_again():
    assert config_from(flatten_config(Config())) == Config()


def test_every_setting_has_a_description_that_ends_as_a_sentence():
    for name, kind in sections():
        for item in dataclasses.fields(kind):
            assert item.metadata["doc"].endswith("."), f"{name}.{item.name}"


@pytest.mark.parametrize("name", [n for n in flatten_config(Config()) if n != "method"])
def test_every_setting_refuses_another_type(name: str):
    with pytest.raises(InvalidConfig, match=f"^{re.escape(name)}: expected"):
        config_from({name: [1]})


def test_unknown_setting_is_refused_by_name():
    with pytest.raises(InvalidConfig, match=r"surface\.radius_mm"):
        config_from({"surface": {"radius_mm": 12.5}})


def test_config_files_are_found_in_the_source_tree(monkeypatch):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert (resources.config_path("categories") / "trousers.yaml").is_file()


def test_config_files_are_found_in_a_ros_prefix(monkeypatch, tmp_path):
    prefix = tmp_path / "install"
    settings = prefix / "share" / "vflatten_ros" / "config"
    settings.mkdir(parents=True)
    (settings / "vflatten.yaml").touch()
    installed = tmp_path / "lib" / "vflatten_ros"
    monkeypatch.setattr(resources, "PACKAGE", installed)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/other:{prefix}")
    assert resources.config_path("vflatten.yaml") == settings / "vflatten.yaml"


def test_a_missing_config_file_tells_where_it_was_looked_for(monkeypatch, tmp_path):
    monkeypatch.setattr(resources, "PACKAGE", tmp_path / "vflatten_ros")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ros"))
    with pytest.raises(InvalidConfig, match=r"nothing\.yaml.*ros/share/vflatten_ros/config"):
        resources.config_path("nothing.yaml")


@pytest.mark.slow
def test_pip_installs_the_core_with_its_config_files(tmp_path):
    """Far from the source tree the package finds its categories and has the command."""
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    for name in ("package.xml", "pyproject.toml", "setup.py", "README.md"):
        shutil.copy(ROOT / name, source)
    for name in ("config", "msg", "vflatten_ros"):
        shutil.copytree(ROOT / name, source / name)
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--target", str(site)]
    pip = [sys.executable, "-m", "pip", "install", *options, str(source)]
    subprocess.run(pip, check=True, cwd=tmp_path)
    code = "from vflatten_ros.resources import config_path; print(config_path('categories'))"
    environment = {"PYTHONPATH": str(site), "PATH": os.defpath}
    found = subprocess.check_output(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, text=True
    )
    assert Path(found.strip()) == site / "vflatten_ros" / "config" / "categories"
    assert (Path(found.strip()) / "trousers.yaml").is_file()
    assert (site / "bin" / "vflatten").is_file()
