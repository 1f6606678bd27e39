import pickle
import subprocess
import sys
from importlib import metadata

import pytest

from adaptune.model.descriptor import descriptor_content
from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.content import odometry_content
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeNdt, KeyframeSettings
from adaptune.odometry.program import CommandSettings
from adaptune.odometry.registry import ODOMETRIES, declare, odometry_class
from adaptune.odometry.remote import Limits, ProcessSettings
from adaptune.space import ODOMETRY, Float, ParameterSpace, SpaceError

MINE = """
from adaptune.odometry import Odometry
from adaptune.space import Float, ParameterSpace

class Mine(Odometry):
    space = ParameterSpace({"x": Float(low=0, high=1, baseline=0.5)})
    def prepare(self, scan): ...
    def start(self, prepared, T_odom_sensor, T_previous_current=None): ...
    def register(self, prepared): ...

class Lacking(Odometry):
    pass

class OfDict(Mine):
    space = {"x": 1}

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
        ("my_odometry:Lacking", r"its `space` is missing; write it as space = ParameterSpace\(\{"),
        ("my_odometry:OfDict", r"its `space` is a dict; write it as space = ParameterSpace\(\{"),
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
    told = r"my_lacking:Mine: cannot import my_lacking \(Float\(.*\): baseline: this key is miss"
    with pytest.raises(OdometryError, match=told):
        odometry_class("my_lacking:Mine")


@pytest.mark.usefixtures("mine")
def test_a_class_needs_space_and_methods_and_may_take_more():
    assert not odometry_class("my_odometry:Mine").describe(None).live
    assert odometry_class("my_odometry:More").__name__ == "More"


def test_an_odometry_that_a_package_announces(monkeypatch):
    point = metadata.EntryPoint(
        "theirs", "adaptune.odometry.keyframe:KeyframeGicp", "adaptune.odometries"
    )
    monkeypatch.setattr(
        "adaptune._system.strict.entry_points", lambda group: [point][: "odom" in group]
    )
    assert odometry_class("theirs") is KeyframeGicp
    with pytest.raises(OdometryError, match="did you mean 'theirs'"):
        odometry_class("thiers")


def test_what_serves_an_odometry_imports_little():
    """The processes of odometries are forked from one that has imported this."""
    program = (
        "import sys; before = set(sys.modules); "
        "import adaptune.odometry.registry, adaptune.odometry.keyframe; "
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


def factory(name, **settings):
    cls = odometry_class(name)
    made = cls.settings_type(**settings)
    return OdometryFactory(name, made, cls.describe(made).space, Limits())


def pool():
    return OdometryPool({"gicp": factory("gicp", downsampling=0.4), "coarse": factory("ndt")})


def test_it_makes_the_odometry_that_the_set_names():
    both = pool()
    gicp = both({ODOMETRY: "gicp", **both.factories["gicp"].space.baseline})
    assert type(gicp.odometry) is KeyframeGicp
    assert gicp.odometry.settings.downsampling == 0.4
    ndt = both({ODOMETRY: "coarse"} | both.factories["coarse"].space.baseline | {"resolution": 2.5})
    assert type(ndt.odometry) is KeyframeNdt
    assert ndt.odometry.parameters["resolution"] == 2.5
    # Without a set, the baseline of the first.
    assert type(both().odometry) is KeyframeGicp
    with pytest.raises(SpaceError, match="there is no odometry 'ndt'"):
        both({ODOMETRY: "ndt"})
    with pytest.raises(OdometryError):
        OdometryPool({"a": factory("gicp").__class__("gipc", {}, both.space, Limits())})


def test_it_pickles():
    both = pool()
    copy = pickle.loads(pickle.dumps(both))
    assert copy.identity == both.identity
    assert copy.space == both.space
    assert copy.space.baselines == both.space.baselines
    assert type(copy(both.space.baselines[1]).odometry) is KeyframeNdt


SPACE = ParameterSpace({"keyframe_interval": Float(low=1.0, high=9.0, baseline=2.0)})


def test_it_makes_what_the_name_says():
    gicp = OdometryFactory("gicp", {"downsampling": 0.3}, SPACE, Limits())
    instance = gicp({"keyframe_interval": 4.0})
    assert isinstance(instance, InProcess)
    odometry = instance.odometry
    assert type(odometry) is KeyframeGicp
    assert odometry.settings == gicp.settings == KeyframeSettings(downsampling=0.3)
    given = {"keyframe_interval": 4.0, "downsampling": 0.3}
    assert odometry.parameters == KeyframeGicp.space.baseline | given
    # The baseline of the study's space, not the odometry's own.
    assert gicp().odometry.parameters["keyframe_interval"] == 2.0
    assert gicp.description == KeyframeGicp.describe(gicp.settings)
    assert gicp.identity == {"name": "gicp", "settings": gicp.settings.model_dump(mode="json")}
    assert "version of small_gicp" in gicp.content
    with pytest.raises(OdometryError, match="did you mean 'gicp'"):
        _ = OdometryFactory("gipc", {}, SPACE, Limits()).description


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of the user whose modules must not be imported."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "__init__.py").write_text("raise SystemExit\n")
    (folder / "odometry.py").write_text("raise SystemExit\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return folder


@pytest.mark.parametrize("written_in", ["odometry", "inner"])
def test_a_class_is_its_module_and_the_one_in_which_it_is_written(package, written_in):
    (package / "inner.py").write_text("1")
    what = "theirs.odometry:Mine", None, f"theirs.{written_in}"
    before = odometry_content(*what)
    assert set(before) == {"module theirs.odometry", f"module theirs.{written_in}"}
    (package / f"{written_in}.py").write_text("# another\n")
    assert odometry_content(*what) != before
    assert not any(name.startswith("theirs") for name in sys.modules)


@pytest.mark.parametrize(
    ("name", "package"),
    [("gicp", "small_gicp"), ("vgicp", "small_gicp"), ("ndt", "open3d"), ("mad_icp", "evalio")],
)
def test_a_built_in_one_is_the_version_of_its_package(name, package):
    version = metadata.version(package)
    assert odometry_content(name, None) == {f"version of {package}": version}


def test_a_program_is_its_files(tmp_path):
    script, template, option = (tmp_path / name for name in ("run.py", "p.yaml", "c.txt"))
    for file in (script, template, option):
        file.write_text("a: 1")
    arguments = (sys.executable, str(script), f"--c={option}", "{input}", "x" * 5000, "\0")
    settings = CommandSettings(command=arguments, template=str(template))
    before = odometry_content("command", settings)
    assert set(before) == {sys.executable, str(script), str(template), str(option)}
    for file in (script, template, option):
        file.write_text("b: 2")
        assert odometry_content("command", settings)[str(file)] != before[str(file)]
    served = ProcessSettings(command=(sys.executable, str(script)))
    assert set(odometry_content("process", served)) == {sys.executable, str(script)}
    away = ProcessSettings(address="tcp://there:1")
    assert odometry_content("process", away) == {}


def test_what_code_imports_is_part_of_it(package, tmp_path, monkeypatch):
    # Also from folders without __init__.py, within functions, and from PYTHONPATH.
    other = tmp_path / "other"
    for file in ("utils/poses.py", "utils/deep.py", "core.py", "theirs/rest.py", "bad.py"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("x = 1\n")
    other.mkdir()
    (other / "kit.py").write_text("from theirs import odometry\n")
    (tmp_path / "unused.py").write_text("")
    (tmp_path / "bad.py").write_text("print 'of Python 2'\n")
    (tmp_path / "utils/poses.py").write_text("from .deep import *\nfrom kit import x\n")
    (tmp_path / "core.py").write_text("def run():\n    import utils.poses, numpy, bad\n")
    (package / "odometry.py").write_text("from . import rest\nimport core, adaptune.space\n")
    (tmp_path / "run.py").write_text("import sys\nfrom core import run\n")
    monkeypatch.setenv("PYTHONPATH", str(other))
    settings = CommandSettings(command=(sys.executable, str(tmp_path / "run.py")))
    files = ("core.py", "bad.py", "utils/poses.py", "utils/deep.py", "other/kit.py")
    of_both = [*files, "theirs/odometry.py", "theirs/rest.py"]
    given = ("command", settings), ("theirs.odometry:Mine", None)
    for file in of_both:
        before = [odometry_content(*one) for one in given]
        (tmp_path / file).write_text((tmp_path / file).read_text() + "# changed\n")
        now = [odometry_content(*one) for one in given]
        assert all(a != b for a, b in zip(before, now, strict=True)), file
    assert not any("unused" in key for of in now for key in of)
    assert not any("numpy" in key or "adaptune/" in key for of in now for key in of)


def test_descriptors_of_the_user_are_their_modules(package):
    assert descriptor_content(["ndt"]) == {}
    before = descriptor_content(["ndt", "theirs.odometry:describe"])
    (package / "odometry.py").write_text("# another\n")
    after = descriptor_content(["ndt", "theirs.odometry:describe"])
    assert before.keys() == after.keys() == {"module theirs.odometry"}
    assert before != after


@pytest.mark.parametrize("name", ODOMETRIES)
def test_the_version_of_every_odometry_is_known(name):
    settings, description = declare(name, {}).sound(name)
    content = odometry_content(name, settings, description.module)
    assert content
    assert "unknown" not in content.values()
