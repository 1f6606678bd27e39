import sys
from importlib import metadata

import pytest

from adaptune.model.descriptor import descriptor_content
from adaptune.odometry.program import CommandSettings
from adaptune.odometry.registry import odometry_content
from adaptune.odometry.remote import ProcessSettings


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of the user whose modules must not be imported."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "__init__.py").write_text("raise SystemExit\n")
    (folder / "odometry.py").write_text("raise SystemExit\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return folder


def test_a_class_is_its_module(package):
    before = odometry_content("theirs.odometry:Mine", None)
    assert list(before) == ["module theirs.odometry"]
    (package / "odometry.py").write_text("# another\n")
    assert odometry_content("theirs.odometry:Mine", None) != before
    assert not any(name.startswith("theirs") for name in sys.modules)


@pytest.mark.parametrize(
    ("name", "package"),
    [("gicp", "small_gicp"), ("vgicp", "small_gicp"), ("ndt", "open3d"), ("mad_icp", "evalio")],
)
def test_a_built_in_one_is_the_version_of_its_package(name, package):
    version = metadata.version(package)
    assert odometry_content(name, None) == {f"version of {package}": version}


def test_a_program_is_its_files(tmp_path):
    script, template = tmp_path / "run.py", tmp_path / "template.yaml"
    script.write_text("1")
    template.write_text("a: 1")
    arguments = (sys.executable, str(script), "{input}", "x" * 5000, "\0")
    settings = CommandSettings(command=arguments, template=str(template))
    before = odometry_content("command", settings)
    assert set(before) == {sys.executable, str(script), str(template)}
    for file in (script, template):
        file.write_text("b: 2")
        assert odometry_content("command", settings)[str(file)] != before[str(file)]
    served = ProcessSettings(command=(sys.executable, str(script)))
    assert set(odometry_content("process", served)) == {sys.executable, str(script)}
    away = ProcessSettings(address="tcp://there:1")
    assert odometry_content("process", away) == {}


def test_descriptors_of_the_user_are_their_modules(package):
    assert descriptor_content(["ndt", "motion"]) == {}
    before = descriptor_content(["ndt", "theirs.odometry:describe"])
    (package / "odometry.py").write_text("# another\n")
    after = descriptor_content(["ndt", "theirs.odometry:describe"])
    assert before.keys() == after.keys() == {"module theirs.odometry"}
    assert before != after


def test_a_class_is_also_the_module_in_which_it_is_written(package):
    (package / "inner.py").write_text("1")
    before = odometry_content("theirs.odometry:Mine", None, "theirs.inner")
    assert set(before) == {"module theirs.odometry", "module theirs.inner"}
    (package / "inner.py").write_text("2")
    assert odometry_content("theirs.odometry:Mine", None, "theirs.inner") != before


def test_a_file_behind_an_option_is_part_of_a_program(tmp_path):
    (tmp_path / "c.txt").write_text("1")
    settings = CommandSettings(command=(sys.executable, f"--config={tmp_path}/c.txt"))
    assert set(odometry_content("command", settings)) == {sys.executable, f"{tmp_path}/c.txt"}
