import pytest

from adaptune.recording.inspect import inspect
from adaptune.reference.check import estimated_name, recording_config
from adaptune.reference.stored import EstimateError


def test_the_sequence_is_the_one_that_inspect_proposes(study_file, tmp_path):
    found = inspect(study_file.parent / "one.bag")
    config = recording_config(found)
    assert (config.points, config.reference) == ("/points", "/truth")
    assert recording_config(found, "/other", "/gps").points == "/other"
    assert recording_config(found, "/other", "/gps").reference == "/gps"
    poses = tmp_path / "poses.tum"
    poses.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    with pytest.raises(EstimateError, match="file of poses"):
        recording_config(inspect(poses))


def test_its_name_is_that_of_the_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert estimated_name(tmp_path / "hall.bag") == "hall_reference"
    assert estimated_name(type(tmp_path)()) == f"{tmp_path.name}_reference"
