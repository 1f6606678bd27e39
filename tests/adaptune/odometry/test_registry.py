import subprocess
import sys
from importlib import metadata

import pytest

from adaptune.odometry import OdometryError
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.registry import odometry_class

MINE = """
from adaptune.odometry import Odometry
from adaptune.space import Float, ParameterSpace

class Mine(Odometry):
    space = ParameterSpace({"x": Float(low=0, high=1, baseline=0.5)})
    live = False
    def prepare(self, scan): ...
    def start(self, prepared, T_odom_sensor, T_previous_current=None): ...
    def register(self, prepared): ...

class Lacking(Odometry):
    pass

class OfDict(Mine):
    space = {"x": 1}

class OfType(Mine):
    settings_type = dict

class Half(Odometry):
    space, live = Mine.space, True
    def prepare(self, scan): ...

class Other(Mine):
    def __init__(self, voxel): ...

class More(Mine):
    def __init__(self, parameters=None, settings=None, voxel=1.0): ...

other = 3
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    (tmp_path / "my_odometry.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("my_odometry", None)


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gipc", "there is no odometry 'gipc': did you mean 'gicp'.*module:Class"),
        ("no_such_module:Mine", "cannot import no_such_module .*PYTHONPATH"),
        ("my_odometry:Mime", "my_odometry has no Mime"),
        ("my_odometry:", "my_odometry has no class"),
        ("my_odometry:other", "not a class derived from adaptune.odometry.Odometry"),
        ("my_odometry:Lacking", "has no attribute space and no live"),
        ("my_odometry:OfDict", r"its `space` is a dict; write it as space = ParameterSpace\(\{"),
        ("my_odometry:OfType", "its `settings_type` is <class 'dict'>, and not derived from Base"),
        ("my_odometry:Half", "the class lacks the methods register and start"),
        ("my_odometry:Other", r"its __init__ takes \(voxel\); write __init__\(self, parameters="),
    ],
)
def test_names_that_do_not_do(name, message):
    with pytest.raises(OdometryError, match=message):
        odometry_class(name)


def test_a_parameter_without_its_baseline_is_named(tmp_path, monkeypatch):
    (tmp_path / "my_lacking.py").write_text(MINE.replace(", baseline=0.5", ""))
    monkeypatch.syspath_prepend(str(tmp_path))
    told = r"my_lacking:Mine: cannot import my_lacking \(Float: baseline: this key is missing\)"
    with pytest.raises(OdometryError, match=told):
        odometry_class("my_lacking:Mine")


@pytest.mark.usefixtures("mine")
def test_a_class_may_take_more():
    assert odometry_class("my_odometry:More").__name__ == "More"


def test_an_odometry_that_a_package_announces(monkeypatch):
    point = metadata.EntryPoint(
        "theirs", "adaptune.odometry.keyframe:KeyframeGicp", "adaptune.odometries"
    )
    monkeypatch.setattr("adaptune.strict.entry_points", lambda group: [point][: "odom" in group])
    assert odometry_class("theirs") is KeyframeGicp
    with pytest.raises(OdometryError, match="did you mean 'theirs'"):
        odometry_class("thiers")


def test_what_serves_an_odometry_imports_little():
    """The processes of odometries are forked from one that has imported this."""
    program = (
        "import sys; before = set(sys.modules); "
        "import adaptune.odometry.serving, adaptune.odometry.keyframe; "
        "found = [m for m in set(sys.modules) - before if '.' not in m]; "
        "print(*(m for m in found if 'site-packages' in str(sys.modules[m])))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    assert set(done.stdout.split()) <= {
        *("annotated_types", "numpy", "pydantic", "pydantic_core", "scipy", "small_gicp"),
        *("typing_extensions", "typing_inspection", "yaml"),  # what the reference image has
    }
